"""Find hallways: pairs of parallel walls with the scanner between them, longer than their distance."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from gpusense._util.angles import wrapped
from gpusense.features.lines import in_robot_frame, scores_of
from gpusense.features.result import Found
from gpusense.features.segments import Segments

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
    observed = np.zeros((len(a), 2, 3))
    observed[:, 0, 0], observed[:, 0, 1], observed[:, 1, 2] = np.cos(normal), np.sin(normal), 1
    axis = np.mod(normal + math.pi, math.pi) - math.pi / 2
    pose = np.column_stack([offset * np.cos(normal), offset * np.sin(normal), axis])
    score = scores_of(segments, a) * scores_of(segments, b)
    return Found(segments.scan[a], pose, observed, covariance, width * np.cos(0.5 * off), score)


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

    def on_another_axis(k: int, j: int) -> bool:
        return abs(math.remainder(angle[k] - angle[j], math.pi)) > _ONE_AXIS

    return np.sort(first_apart(np.lexsort((-length.max(axis=0), -length.min(axis=0), scan)), scan, on_another_axis))


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
