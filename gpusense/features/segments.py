"""Split scans into straight segments on a device, with their lines, neighbours and noise."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from gpusense.backends import Backend
from gpusense.backends.workspace import Workspace
from gpusense.interface.constants import CIRCLE_NUMBERS, LINE_NUMBERS
from gpusense.interface.flags import flags_if
from gpusense.interface.launches import launch
from gpusense.matching.points import GAP, ScanPoints
from gpusense.world.scanner import Reading, Scanner, reading_classes

_INT = np.dtype(np.int32)


class ScanDevice:
    """Points of scans on a device, and their noise."""

    def __init__(self, backend: Backend, real: np.dtype, points: ScanPoints, noise: np.ndarray) -> None:
        self._backend, self._real = backend, real
        self._flags = flags_if(FLOAT64=real == np.float64)
        self._sizes = {"scans": len(noise), "points": len(points.point)}
        self._gap = points.gap
        self._space = Workspace(backend)
        self._arrays = {"point": points.point.astype(real), "start": points.start, "noise": noise.astype(real)}

    def split(self, penalty: float, point: np.ndarray) -> np.ndarray:
        """Return the end of the segment that begins at each ordered point, or -1; a split must gain ``penalty``."""
        points = self._sizes["points"]
        stop = np.empty(points, _INT)
        with self._space as space:
            cost = space.empty("cost", points, self._real)
            out = space.empty("stop", points, _INT)
            placed = space.upload("ordered", point.astype(self._real))
            self._run("split_scans", self._sizes["scans"], point=placed, cost=cost, stop=out, penalty=penalty,
                      gap=self._gap)  # fmt: skip
            space.download(out, stop)
            space.wait()
        return stop

    def lines(self, part: np.ndarray, scan: np.ndarray) -> np.ndarray:
        """Return the lines (P, 6) of parts (P, 2) of scans, as the kernel file describes them."""
        return self._parts("fit_segments", "line", LINE_NUMBERS, part, scan)

    def circles(self, part: np.ndarray, scan: np.ndarray, edge: np.ndarray) -> np.ndarray:
        """Return the circles (P, 10) of parts of scans, with edges (P, 4), as the kernel file describes them."""
        return self._parts("fit_circles", "circle", CIRCLE_NUMBERS, part, scan, edge=edge.astype(self._real))

    def _parts(
        self, kernel: str, name: str, numbers: int, part: np.ndarray, scan: np.ndarray, **more: np.ndarray
    ) -> np.ndarray:
        """Return the (P, numbers) array that a kernel writes, one row per part."""
        count = len(part)
        found = np.empty((count, numbers), self._real)
        if count:
            with self._space as space:
                out = space.empty(name, numbers * count, self._real)
                arrays = {"part": part.astype(_INT), "scan": scan.astype(_INT), **more}
                uploaded = {key: space.upload(key, value) for key, value in arrays.items()}
                self._run(kernel, count, **uploaded, **{name: out}, parts=count)
                space.download(out, found)
                space.wait()
        return found.astype(np.float64)

    def _run(self, kernel: str, size: int, **arguments: Any) -> None:
        placed = {key: self._space.upload(key, value) for key, value in self._arrays.items() if key not in arguments}
        self._backend.run((launch(kernel, self._flags, (size,), **placed, **self._sizes, **arguments),))


_FULL_TURN = 2 * math.pi
# Least reduction of the cost for replacing a line by two [squared deviations].
PENALTY = 25.0
# Degrees of freedom of the scan's noise as a prior for each segment's noise.
_PRIOR = 20.0
# Least standard deviation of ranges in a covariance [m].
LEAST_NOISE = 2e-4
# Largest step between the bearings of neighbouring beams [usual steps].
NEIGHBOURS = 1.5


@dataclass(frozen=True)
class Segments:
    """Segments of all scans by bearing, each with a line ``x cos(angle) + y sin(angle) = distance``."""

    points: ScanPoints  # the points of all scans
    scan: np.ndarray  # (G,) the scan
    first: np.ndarray  # (G,) first point
    count: np.ndarray  # (G,) points
    angle: np.ndarray  # (G,) direction of the line's normal, away from the sensor [rad]
    distance: np.ndarray  # (G,) distance of the line from the sensor [m], NaN without a line
    covariance: np.ndarray  # (G, 2, 2) of angle and distance
    cost: np.ndarray  # (G,) sum of squared deviations of ranges over their variance
    variance: np.ndarray  # (G,) variance of ranges, from the scan and from the segment's residuals [m^2]
    ends: np.ndarray  # (G, 2) positions of the first and last point along the line, from the foot of the normal [m]
    spacing: np.ndarray  # (G, 2) distances between neighbouring beams along the line at its ends [m]
    successor: np.ndarray  # (G,) next segment of the scan, or -1; the first follows the last without a gap
    apart: np.ndarray  # (G,) whether an object may be hidden in front of the successor

    @property
    def step(self) -> float:
        """Usual step between bearings [rad]."""
        return self.points.gap / GAP

    @property
    def length(self) -> np.ndarray:
        """(G,) lengths [m]."""
        return self.ends[:, 1] - self.ends[:, 0]

    @property
    def last(self) -> np.ndarray:
        """(G,) last point of each segment."""
        begin = self.points.start[self.scan]
        return begin + (self.first - begin + self.count - 1) % self.points.counts[self.scan]

    def place(self, which: np.ndarray, along: np.ndarray) -> np.ndarray:
        """Return the points (P, 2) at positions along lines."""
        c, s, d = np.cos(self.angle[which]), np.sin(self.angle[which]), self.distance[which]
        return np.stack([d * c - along * s, d * s + along * c], axis=1)

    def at(self, which: np.ndarray, along: np.ndarray) -> np.ndarray:
        """Return the covariances (P, 2, 2) of offset and direction of lines at positions along them."""
        jacobian = np.zeros((len(which), 2, 2))
        jacobian[:, 0, 0], jacobian[:, 0, 1], jacobian[:, 1, 0] = -along, 1, 1
        result: np.ndarray = jacobian @ self.covariance[which] @ jacobian.transpose(0, 2, 1)
        return result


def find_segments(device: ScanDevice, points: ScanPoints, noise: np.ndarray) -> Segments:
    """Split scans into segments by bearing, from each scan's cut on (see :func:`_cut`), and fit lines to them."""
    if not len(points.point):
        nothing = np.zeros(0, np.int64)
        return _described(points, np.zeros(len(noise), bool), noise, nothing, nothing, nothing, np.zeros((0, 6)))
    cut, closed, mirrored = _cut(points, noise)
    place, point = _in_cut_order(points, cut, mirrored)
    stop = device.split(PENALTY, point)
    first = np.flatnonzero(stop >= 0)
    scan = np.searchsorted(points.start, first, side="right") - 1
    count = stop[first] - first
    # In a mirrored scan, the first point of a segment by bearing is its last point.
    first = place[np.where(mirrored[scan], first + count - 1, first)]
    order = np.lexsort((np.mod(first - cut[scan], points.counts[scan]), scan))
    first, count, scan = first[order], count[order], scan[order]
    line = device.lines(np.stack([first, count], axis=1), scan)
    first, count, scan, line = _joined_around(device, closed, first, count, scan, line)
    return _described(points, closed, noise, first, count, scan, line)


def _cut(points: ScanPoints, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return where to cut scans open, from their readings only, so that segments turn and mirror with their scans.

    A scan is cut at its widest gap, or at the range that deviates most from its neighbours' prediction: an edge or a
    corner. The results (S,) are the first point after the cut, whether the cut is not at a gap, and whether to split
    against the sense of bearings, where the sum of cubed steps of log ranges is negative.
    """
    counts, total = points.counts, len(points.point)
    scan = np.repeat(np.arange(len(counts)), counts)
    begin, number = points.start[scan], np.arange(total)
    following = begin + (number - begin + 1) % counts[scan]
    before = begin + (number - begin - 1) % counts[scan]
    bearing, r = points.point[:, 2].astype(np.float64), points.point[:, 3].astype(np.float64)
    step = np.where(following == number, _FULL_TURN, np.mod(bearing[following] - bearing, _FULL_TURN))
    is_gap = step > points.gap
    # On a straight wall 1 / r = a cos(bearing) + b sin(bearing).
    one, two = np.sin(step[before]), np.sin(step)
    with np.errstate(all="ignore"):
        expected = (two / r[before] + one / r[following]) / np.sin(step[before] + step)
        off = np.nan_to_num(np.abs(expected * r - 1) * r / noise[scan], posinf=0.0)
    # Gaps of equally many beams are equally wide.
    beams = np.minimum(np.rint(step * GAP / max(points.gap, 1e-9)), 1e9)
    score = np.where(is_gap, 1e9 * beams, np.minimum(off + off[following], 1e8))
    some = np.flatnonzero(counts)
    best = np.lexsort((-number, score, scan))[points.start[some + 1] - 1]
    cut, closed, mirrored = np.zeros(len(counts), np.int64), np.zeros(len(counts), bool), np.zeros(len(counts), bool)
    cut[some], closed[some] = following[best], ~is_gap[best]
    cubes = np.log(r[following] / r) ** 3
    mirrored[some] = np.add.reduceat(cubes, points.start[some]) < 0
    return cut, closed, mirrored


def _in_cut_order(points: ScanPoints, cut: np.ndarray, mirrored: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices of points (P,) from the cut on, and the points for kernels, with bearings from the cut."""
    counts = points.counts
    scan = np.repeat(np.arange(len(counts)), counts)
    begin = points.start[scan]
    number = np.arange(len(scan)) - begin
    place = begin + np.where(mirrored[scan], cut[scan] - begin - 1 - number, cut[scan] - begin + number) % counts[scan]
    bearing, r = points.point[:, 2].astype(np.float64), points.point[:, 3].astype(np.float64)
    turned = np.mod(np.where(mirrored[scan], -1, 1) * (bearing[place] - bearing[place[begin]]), _FULL_TURN)
    r = r[place]
    return place, np.stack([r * np.cos(turned), r * np.sin(turned), turned, r], axis=1)


def _joined_around(
    device: ScanDevice, closed: np.ndarray, first: np.ndarray, count: np.ndarray, scan: np.ndarray, line: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Join the last and first segment of a scan where a single line explains both."""
    begin = np.searchsorted(scan, np.arange(len(closed)))
    end = np.searchsorted(scan, np.arange(len(closed)), side="right") - 1
    rows = np.flatnonzero(closed & (end > begin))
    head, tail = begin[rows], end[rows]
    part = np.stack([first[tail], count[tail] + count[head]], axis=1)
    joint = device.lines(part, rows)
    apart = line[head, 5] + line[tail, 5]
    joins = (joint[:, 5] >= 0) & (line[head, 5] >= 0) & (line[tail, 5] >= 0) & (joint[:, 5] - apart < PENALTY)
    count, line = count.copy(), line.copy()
    count[tail[joins]], line[tail[joins]] = part[joins, 1], joint[joins]
    kept = np.ones(len(first), bool)
    kept[head[joins]] = False
    return first[kept], count[kept], scan[kept], line[kept]


def _described(
    points: ScanPoints, closed: np.ndarray, noise: np.ndarray, first: np.ndarray, count: np.ndarray,
    scan: np.ndarray, line: np.ndarray,
) -> Segments:  # fmt: skip
    """Return segments with all attributes derived from their lines."""
    a, b, r11, r12, r22, cost = line.T
    size = np.hypot(a, b)
    valid = (cost >= 0) & (r22 > 0) & (count >= 3) & np.isfinite(line).all(axis=1) & (size > 0)
    with np.errstate(all="ignore"):
        angle, distance = np.arctan2(b, a), np.where(valid, 1 / size, np.nan)
        inverse = np.zeros((len(a), 2, 2))
        inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1] = 1 / r11, -r12 / (r11 * r22), 1 / r22
        jacobian = np.stack([-b / size**2, a / size**2, -a / size**3, -b / size**3], axis=1).reshape(-1, 2, 2)
        root = jacobian @ inverse
    variance = _variances(noise, scan, count, cost, valid)
    scaled = variance / noise[scan] ** 2
    covariance = np.where(valid[:, None, None], root @ root.transpose(0, 2, 1) * scaled[:, None, None], np.inf)
    begin, total = points.start[scan], points.counts[scan]
    last = begin + (first - begin + count - 1) % np.maximum(total, 1)
    bearing = points.point[:, 2].astype(np.float64)
    step = points.gap / GAP
    turn = np.stack([bearing[first], bearing[last]], axis=1) - angle[:, None]
    turn = np.mod(turn + math.pi, _FULL_TURN) - math.pi
    with np.errstate(all="ignore"):
        ends = distance[:, None] * np.tan(np.clip(turn, -1.57, 1.57))
        spacing = distance[:, None] * step / np.square(np.cos(turn))
    successor, apart = _successors(points, closed, scan, first, last)
    return Segments(
        points, scan, first, count, angle, distance, covariance, cost, variance, ends, spacing, successor, apart
    )


def _variances(
    noise: np.ndarray, scan: np.ndarray, count: np.ndarray, cost: np.ndarray, valid: np.ndarray
) -> np.ndarray:
    """Return the variance of ranges (G,), from the good segments of the scan and the residuals of each segment."""
    free = np.maximum(count - 2, 0)
    squares = noise[scan] ** 2 * np.where(valid, cost, 0)
    good = valid & (count >= 6)
    scans = len(noise)
    sums = np.bincount(scan[good], squares[good], scans) + 4 * noise**2
    whole = np.maximum(sums / (np.bincount(scan[good], free[good], scans) + 4), LEAST_NOISE**2)
    own = (_PRIOR * whole[scan] + squares) / (_PRIOR + free)
    return np.maximum(own, LEAST_NOISE**2)


def _successors(
    points: ScanPoints, closed: np.ndarray, scan: np.ndarray, first: np.ndarray, last: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the successor of each segment, or -1, and whether an object may be hidden in between."""
    number = np.arange(len(scan))
    head = np.searchsorted(scan, scan)
    is_last = np.append(scan[1:] != scan[:-1], True)[: len(scan)]
    successor = np.where(is_last, np.where(closed[scan] & (head != number), head, -1), number + 1)
    bearing = points.point[:, 2].astype(np.float64)
    step = np.mod(bearing[first[successor]] - bearing[last], _FULL_TURN)
    return successor, (successor < 0) | (step > points.gap)


@dataclass(frozen=True)
class Beams:
    """Beams of S scans, sorted by bearing."""

    beam: np.ndarray  # (P,) beam of each point
    opens_after: np.ndarray  # (P,) whether the next beam has no return
    opens_before: np.ndarray  # (P,) whether the beam before has no return
    maxima: np.ndarray  # (S, K + 1) number of beams without a return before each beam

    def without_return(self, scan: np.ndarray, last: np.ndarray, first: np.ndarray) -> np.ndarray:
        """Count the beams (P,) without a return between pairs of points of scans, in the direction of bearings."""
        one, two = self.beam[last], self.beam[first]
        between = self.maxima[scan, two] - self.maxima[scan, one]
        result: np.ndarray = between + np.where(two < one, self.maxima[scan, -1], 0)
        return result


def by_bearing(scanner: Scanner) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return the order of the beams by bearing, their bearings, steps to the next ones, and usual step [rad]."""
    angle = np.mod(scanner.bearings + scanner.mount[2], _FULL_TURN)
    order = np.argsort(angle, kind="stable")
    bearing = angle[order]
    steps = np.mod(np.roll(bearing, -1) - bearing, _FULL_TURN)
    return order, bearing, steps, float(np.median(steps)) if len(steps) else 0.0


def beams_of(ranges: np.ndarray, scanner: Scanner, points: ScanPoints) -> Beams:
    """Return the beams of (S, K) readings with these points."""
    order, bearing, steps, usual = by_bearing(scanner)
    state = reading_classes(ranges, scanner.range_min, scanner.range_max)[:, order]
    scan = np.repeat(np.arange(len(ranges)), points.counts)
    beam = _beams_of_points(points, bearing, scan, state)
    beside = steps <= NEIGHBOURS * usual + 1e-12
    is_max = state == Reading.MAX
    after = np.roll(is_max, -1, axis=1) & beside
    before = np.roll(is_max & beside, 1, axis=1)
    maxima = np.concatenate([np.zeros((len(ranges), 1), np.int64), np.cumsum(is_max, axis=1)], axis=1)
    return Beams(beam, after[scan, beam], before[scan, beam], maxima)


def _beams_of_points(points: ScanPoints, bearing: np.ndarray, scan: np.ndarray, state: np.ndarray) -> np.ndarray:
    """Return the beam of each point; points are hits beyond a micrometre, in order."""
    hits = state == Reading.HIT
    if np.count_nonzero(hits) == len(scan):
        return np.nonzero(hits)[1]
    # Hits at range 0 have no point.
    return np.minimum(np.searchsorted(bearing, points.point[:, 2] - 1e-9), max(len(bearing) - 1, 0))
