"""Select lines and hallways among straight segments, and merge lines of several scans into lines of a map."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from gpusense._util.angles import wrapped
from gpusense._util.typing import Floats
from gpusense.features.feature_map import FeatureMap
from gpusense.features.result import KIND_TYPE, Features, Found, across_lines, turned_axes
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


# Pieces of one line agree within this many deviations plus this offset [m] and angle [rad], with at most this gap
# [m].
_JOINED_DEVIATIONS, _JOINED_FLOOR, _JOINED_TURN, _JOINED_GAP = 4.0, 0.03, 0.02, 0.3
# Largest difference in direction between compared lines [rad].
_ALIKE = 0.15
# Most passes that join lines after they have grown.
_PASSES = 4


@dataclass
class _Pieces:
    """Pieces of lines in the world."""

    middle: np.ndarray  # (P, 2) middles [m]
    theta: np.ndarray  # (P,) directions, the free side on the left [rad]
    half: np.ndarray  # (P,) half lengths [m]
    covariance: np.ndarray  # (P, 2, 2) of the offset to the left at the middle and of the direction


def lines_of(features: Features, poses: Floats, spread: Floats, least: int) -> FeatureMap:
    """Merge lines of scans into the lines of a map."""
    own = _in_world(features, poses, spread)
    pieces, label = own, np.arange(len(features))
    for _ in range(_PASSES):
        again = _labels(pieces)
        label = again[label]
        count = int(label.max(initial=-1)) + 1
        if count == len(pieces.theta):
            break
        pieces = _fused(own, label, count)
    rows = [i for i in range(len(pieces.theta)) if len(np.unique(features.scan[label == i])) >= least]
    sine, cosine = np.sin(pieces.theta[rows]), np.cos(pieces.theta[rows])
    normal = np.column_stack([-sine, cosine])
    theta = wrapped(pieces.theta[rows])
    return FeatureMap(
        np.full(len(rows), "line", KIND_TYPE), np.column_stack([pieces.middle[rows], theta]),
        pieces.covariance[rows, 0, 0, None, None] * normal[:, :, None] * normal[:, None, :], 2 * pieces.half[rows],
        np.bincount(label, minlength=len(pieces.theta))[rows],
    )  # fmt: skip


def _in_world(features: Features, poses: Floats, spread: Floats) -> _Pieces:
    """Return lines of scans in the world; covariances include the errors of poses."""
    at = poses[features.scan]
    c, s = np.cos(at[:, 2]), np.sin(at[:, 2])
    off = np.stack([c * features.pose[:, 0] - s * features.pose[:, 1],
                    s * features.pose[:, 0] + c * features.pose[:, 1]], axis=1)  # fmt: skip
    theta = at[:, 2] + features.pose[:, 2]
    # A heading error moves the middle across by the error times its distance along the line.
    lever = np.cos(theta) * off[:, 0] + np.sin(theta) * off[:, 1]
    turned = np.stack([lever, np.ones_like(lever)], axis=1) * spread[1]
    # Positive to the left, towards the scanner.
    covariance = across_lines(features) * ((1, -1), (-1, 1)) + turned[:, :, None] * turned[:, None, :]
    covariance[:, 0, 0] += spread[0] ** 2
    return _Pieces(at[:, :2] + off, theta, 0.5 * features.size, covariance)


class _Lines:
    """Growing lines, each with its offset and direction in the frame of its first piece."""

    def __init__(self, most: int) -> None:
        self.count = 0
        self._origin, self._theta, self._ends = np.zeros((most, 2)), np.zeros(most), np.zeros((most, 2))
        self._information, self._sum = np.zeros((most, 2, 2)), np.zeros((most, 2))
        self._state, self._covariance = np.zeros((most, 2)), np.zeros((most, 2, 2))

    def nearest(self, pieces: _Pieces, i: int) -> int:
        """Return the nearest line that a piece may belong to, or -1."""
        n = self.count
        turn = wrapped(pieces.theta[i] - self._theta[:n])
        near = np.flatnonzero(np.abs(turn) < _ALIKE)
        along, across = _place(self._origin[near], self._theta[near], pieces.middle[i])
        inside = (along - pieces.half[i] < self._ends[near, 1] + _JOINED_GAP) & (
            along + pieces.half[i] > self._ends[near, 0] - _JOINED_GAP
        )
        near, along, across = near[inside], along[inside], across[inside]
        if not len(near):
            return -1
        row = _rows(along)
        residual = np.stack([across, turn[near]], axis=1) - np.einsum("mij,mj->mi", row, self._state[near])
        both = row @ self._covariance[near] @ row.transpose(0, 2, 1) + pieces.covariance[i]
        both = both + np.diag([_JOINED_FLOOR**2, _JOINED_TURN**2])
        distance = np.einsum("mi,mij,mj->m", residual, np.linalg.inv(both), residual)
        best = int(distance.argmin())
        return int(near[best]) if distance[best] < _JOINED_DEVIATIONS**2 else -1

    def add(self, pieces: _Pieces, i: int) -> int:
        """Add a piece to the nearest line, or begin one; return the line."""
        j = self.nearest(pieces, i)
        if j < 0:
            j = self.count
            self.count += 1
            self._origin[j], self._theta[j] = pieces.middle[i], pieces.theta[i]
            self._ends[j] = np.inf, -np.inf
        along, across = (float(v[0]) for v in _place(self._origin[[j]], self._theta[[j]], pieces.middle[i]))
        turn = float(wrapped(pieces.theta[i] - self._theta[j]))
        row, information = _rows(np.array([along]))[0], np.linalg.inv(pieces.covariance[i])
        self._information[j] += row.T @ information @ row
        self._sum[j] += row.T @ information @ (across, turn)
        self._covariance[j] = np.linalg.inv(self._information[j])
        self._state[j] = self._covariance[j] @ self._sum[j]
        self._ends[j] = min(self._ends[j, 0], along - pieces.half[i]), max(self._ends[j, 1], along + pieces.half[i])
        return j


def _place(origin: np.ndarray, theta: np.ndarray, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the coordinates of points along lines, and across them to the left."""
    (x, y), c, s = (point - origin).T, np.cos(theta), np.sin(theta)
    return c * x + s * y, c * y - s * x


def _rows(along: np.ndarray) -> np.ndarray:
    """Return the matrices (P, 2, 2) that propagate a line's offset and direction from 0 to positions along it."""
    rows = np.zeros((len(along), 2, 2))
    rows[:, 0, 0] = rows[:, 1, 1] = 1
    rows[:, 0, 1] = along
    return rows


def _labels(pieces: _Pieces) -> np.ndarray:
    """Return the line of each piece, the longest and most certain pieces first."""
    label = np.zeros(len(pieces.theta), np.int64)
    if len(label):
        lines = _Lines(len(label))
        for i in np.argsort(pieces.covariance[:, 1, 1], kind="stable").tolist():
            label[i] = lines.add(pieces, i)
    return label


def _fused(own: _Pieces, label: np.ndarray, count: int) -> _Pieces:
    """Return each line as the mean of its pieces, weighted by information, from end to end."""
    middle, theta, half = np.zeros((count, 2)), np.zeros(count), np.zeros(count)
    covariance = np.zeros((count, 2, 2))
    order = np.argsort(label, kind="stable")
    for j, rows in enumerate(np.split(order, np.cumsum(np.bincount(label, minlength=count))[:-1])):
        first = rows[own.covariance[rows, 1, 1].argmin()]
        origin, start = own.middle[first], own.theta[first]
        along, across = _place(np.tile(origin, (len(rows), 1)), np.full(len(rows), start), own.middle[rows])
        turn = wrapped(own.theta[rows] - start)
        ends = (along - own.half[rows]).min(), (along + own.half[rows]).max()
        centre = 0.5 * (ends[0] + ends[1])
        row, information = _rows(along - centre), np.linalg.inv(own.covariance[rows])
        observed = np.stack([across, turn], axis=1)
        weighted = row.transpose(0, 2, 1) @ information
        inverse = np.linalg.inv((weighted @ row).sum(axis=0))
        state = inverse @ (weighted @ observed[..., None]).sum(axis=0)[:, 0]
        rest = observed - row @ state
        scatter = np.einsum("pi,pij,pj->", rest, information, rest) / max(2 * len(rows) - 2, 1)
        c, s = math.cos(start), math.sin(start)
        middle[j] = origin + centre * np.array([c, s]) + state[0] * np.array([-s, c])
        theta[j], half[j] = start + state[1], 0.5 * (ends[1] - ends[0])
        covariance[j] = inverse * max(scatter, 1.0)
    return _Pieces(middle, theta, half, covariance)
