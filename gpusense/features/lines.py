"""Select lines and hallways among straight segments."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from gpusense._util.angles import wrapped
from gpusense.features.result import Found, turned_axes
from gpusense.features.segments import PENALTY, ScanDevice, Segments

# Least points and length [m] of a line, and largest deviation of its direction [rad].
LEAST_POINTS, LEAST_LENGTH, LARGEST_DEVIATION = 6, 0.3, 0.06
# Limits for a side of a corner.
SIDE_POINTS, SIDE_LENGTH, SIDE_DEVIATION = 4, 0.15, 0.1
# Largest mean squared deviation per degree of freedom of a line.
POOR = 3.0
# Additional cost of a circle that still beats two lines with their additional parameters; the same next to a round
# part; passes.
_ROUND, _ROUND_BESIDE, _ROUNDS = 12.0, 35.0, 4
# Least and largest turn of a round wall between two segments [rad].
_LEAST_TURN, _LARGEST_TURN = 0.02, 1.4


class Frame(NamedTuple):
    """Lines in the robot's frame: directions of their normals, distances from the robot, and covariances of both."""

    angle: np.ndarray
    distance: np.ndarray
    covariance: np.ndarray


def straight(device: ScanDevice, segments: Segments) -> tuple[np.ndarray, np.ndarray]:
    """Return which segments (G,) are lines, and which may be (shorter) sides of corners."""
    deviation = np.sqrt(segments.covariance[:, 0, 0])
    free = np.maximum(segments.count - 2, 1)
    good = np.isfinite(segments.distance) & (segments.cost <= POOR * free + PENALTY) & ~_is_round(device, segments)
    line = good & (segments.count >= LEAST_POINTS) & (segments.length >= LEAST_LENGTH)
    side = good & (segments.count >= SIDE_POINTS) & (segments.length >= SIDE_LENGTH)
    return line & (deviation <= LARGEST_DEVIATION), side & (deviation <= SIDE_DEVIATION)


def _is_round(device: ScanDevice, segments: Segments) -> np.ndarray:
    """Return which segments (G,) a common circle with a neighbour explains as well as two lines."""
    number = np.arange(len(segments.scan))
    other = segments.successor
    usable = np.isfinite(segments.distance) & (segments.count >= 3)
    pair = (other >= 0) & ~segments.apart & usable & usable[other] & (other != number)
    pair &= (segments.cost >= 0) & (segments.cost[other] >= 0)
    one = number[pair]
    two = other[one]
    part = np.stack([segments.first[one], segments.count[one] + segments.count[two]], axis=1)
    circle = device.circles(part, segments.scan[one], np.zeros((len(one), 4)))
    apart = segments.cost[one] + segments.cost[two]
    turn = np.abs(wrapped(segments.angle[two] - segments.angle[one]))
    arc = (circle[:, 3] >= 0) & (turn > _LEAST_TURN) & (turn < _LARGEST_TURN)
    found = np.zeros(len(number), bool)
    sure = arc & (circle[:, 3] <= apart + _ROUND)
    for _ in range(_ROUNDS):
        found[one[sure]] = True
        found[two[sure]] = True
        # Weaker evidence suffices next to a round part.
        sure = arc & (found[one] | found[two]) & (circle[:, 3] <= apart + _ROUND_BESIDE)
    return found


def in_robot_frame(segments: Segments, mount: tuple[float, float, float]) -> Frame:
    """Return the lines of segments in the robot's frame."""
    c, s = np.cos(segments.angle), np.sin(segments.angle)
    ahead, aside = c * mount[0] + s * mount[1], -s * mount[0] + c * mount[1]
    jacobian = np.zeros((len(c), 2, 2))
    jacobian[:, 0, 0] = jacobian[:, 1, 1] = 1
    jacobian[:, 1, 0] = aside
    covariance = (
        jacobian @ np.where(np.isfinite(segments.covariance), segments.covariance, 0) @ jacobian.transpose(0, 2, 1)
    )
    return Frame(segments.angle, segments.distance + ahead, covariance)


def scores_of(segments: Segments, which: np.ndarray) -> np.ndarray:
    """Return the quality (P,) of lines in 0 to 1."""
    fit = np.minimum(1, np.maximum(segments.count[which] - 2, 1) / np.maximum(segments.cost[which], 1e-9))
    sure = 1 - np.sqrt(segments.covariance[which, 0, 0]) / LARGEST_DEVIATION
    result: np.ndarray = np.clip(fit, 0, 1) * np.clip(sure, 0, 1)
    return result


def find_lines(segments: Segments, which: np.ndarray, mount: tuple[float, float, float]) -> Found:
    """Return the lines of some segments: midpoint and direction, with observed offset and direction."""
    angle, middle = segments.angle[which], segments.ends[which].mean(axis=1)
    xy = segments.place(which, middle) + np.array(mount[:2])
    pose = np.column_stack([xy, angle + math.pi / 2])
    covariance, length = segments.at(which, middle), segments.length[which]
    return Found(segments.scan[which], pose, turned_axes(angle)[:, ::2], covariance, length, scores_of(segments, which))


# Least and largest width [m], and least length over which the walls face each other [widths].
_NARROWEST, _WIDEST, _LEAST_LENGTH = 0.6, 3.2, 2.0
# Parallel walls differ by at most this angle [rad] plus this many deviations; lines of one wall by at most this offset
# [m].
_PARALLEL, _DEVIATIONS, _SAME = math.radians(2), 3.0, 0.06
# Hallways of a scan with axes within this angle are one hallway [rad].
_ONE_AXIS = math.radians(15)


def pairs_of(scan: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return all ordered pairs (i, j), i < j, of rows with the same scan; rows are sorted by scan."""
    end = np.searchsorted(scan, scan, side="right")
    number = np.arange(len(scan))
    count = end - number - 1
    one = np.repeat(number, count)
    two = np.arange(len(one)) - np.repeat(np.cumsum(count) - count, count) + one + 1
    return one, two


def find_hallways(segments: Segments, straight: np.ndarray, mount: tuple[float, float, float]) -> Found:
    """Return the hallways of scans: axis point abreast of the robot, with observed offset and direction."""
    lines = np.flatnonzero(straight)
    low, high = _extents(segments, lines)
    one, two = pairs_of(segments.scan[lines])
    frame = in_robot_frame(segments, mount)
    a, b = lines[one], lines[two]
    off = wrapped(segments.angle[a] - segments.angle[b] - math.pi)
    deviation = np.sqrt(segments.covariance[a, 0, 0] + segments.covariance[b, 0, 0])
    width = frame.distance[a] + frame.distance[b]
    # Positions along the second wall run the opposite way.
    overlap = np.minimum(high[one], -low[two]) - np.maximum(low[one], -high[two])
    good = (np.abs(off) <= _PARALLEL + _DEVIATIONS * deviation) & (width >= _NARROWEST) & (width <= _WIDEST)
    good &= overlap >= _LEAST_LENGTH * width
    a, b, off, overlap, width = (value[good] for value in (a, b, off, overlap, width))
    kept = _one_each(segments.scan[a], segments.angle[a], np.stack([segments.length[a], segments.length[b]]))
    a, b, off, width = a[kept], b[kept], off[kept], width[kept]
    variance_a, variance_b = segments.covariance[a, 0, 0], segments.covariance[b, 0, 0]
    share = variance_b / (variance_a + variance_b)
    normal = segments.angle[a] - (1 - share) * off
    offset = 0.5 * (frame.distance[a] - frame.distance[b])
    jacobian = np.zeros((len(a), 2, 4))
    jacobian[:, 0, 1], jacobian[:, 0, 3] = 0.5, -0.5
    jacobian[:, 1, 0], jacobian[:, 1, 2] = share, 1 - share
    both = np.zeros((len(a), 4, 4))
    both[:, :2, :2], both[:, 2:, 2:] = frame.covariance[a], frame.covariance[b]
    covariance = jacobian @ both @ jacobian.transpose(0, 2, 1)
    axis = np.mod(normal + math.pi, math.pi) - math.pi / 2
    pose = np.column_stack([offset * np.cos(normal), offset * np.sin(normal), axis])
    score = scores_of(segments, a) * scores_of(segments, b)
    return Found(segments.scan[a], pose, turned_axes(normal)[:, ::2], covariance, width * np.cos(0.5 * off), score)


def _extents(segments: Segments, lines: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the ends of each line's wall along it, including other lines of the same wall."""
    one, two = pairs_of(segments.scan[lines])
    a, b = lines[one], lines[two]
    low, high = segments.ends[lines, 0].copy(), segments.ends[lines, 1].copy()
    off = wrapped(segments.angle[a] - segments.angle[b])
    middle = segments.place(b, segments.ends[b].mean(axis=1))
    c, s = np.cos(segments.angle[a]), np.sin(segments.angle[a])
    across = c * middle[:, 0] + s * middle[:, 1] - segments.distance[a]
    same = (np.abs(off) < 2 * _PARALLEL) & (np.abs(across) < _SAME)
    for first, second in ((one[same], two[same]), (two[same], one[same])):
        np.minimum.at(low, first, segments.ends[lines[second], 0])
        np.maximum.at(high, first, segments.ends[lines[second], 1])
    return low, high


def _one_each(scan: np.ndarray, angle: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Choose the pair of each scan and axis with the longest shorter wall (2, P), then the longest pair."""
    order = np.lexsort((-length.max(axis=0), -length.min(axis=0), scan))
    return np.sort(first_apart(order, scan, lambda k, j: abs(math.remainder(angle[k] - angle[j], math.pi)) > _ONE_AXIS))


def first_apart(order: np.ndarray, scan: np.ndarray, are_apart: Callable[[int, int], bool]) -> np.ndarray:
    """Choose, in ``order`` and scan after scan, each index apart from all previous choices of its scan."""
    kept: list[int] = []
    taken: list[int] = []
    for k in order.tolist():
        if taken and scan[taken[0]] != scan[k]:
            taken = []
        if all(are_apart(k, j) for j in taken):
            taken.append(k)
            kept.append(k)
    return np.array(kept, np.int64)
