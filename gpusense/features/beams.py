"""Sort the beams of scans in the order of points: each has a point, no return, or no information."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gpusense.matching.points import ScanPoints
from gpusense.world.scanner import Reading, Scanner, reading_classes

_FULL_TURN = 2 * math.pi
# Largest step between the bearings of neighbouring beams [usual steps].
_NEIGHBOURS = 1.5


@dataclass(frozen=True)
class Beams:
    """Beams of S scans, sorted by bearing.

    Attributes:
        beam: (P,) beam of each point.
        opens_after: (P,) whether the next beam has no return.
        opens_before: (P,) whether the beam before has no return.
        maxima: (S, K + 1) number of beams without a return before each beam.
    """

    beam: np.ndarray
    opens_after: np.ndarray
    opens_before: np.ndarray
    maxima: np.ndarray

    def without_return(self, scan: np.ndarray, last: np.ndarray, first: np.ndarray) -> np.ndarray:
        """Count the beams (P,) without a return between pairs of points of scans, in the direction of bearings."""
        one, two = self.beam[last], self.beam[first]
        between = self.maxima[scan, two] - self.maxima[scan, one]
        result: np.ndarray = between + np.where(two < one, self.maxima[scan, -1], 0)
        return result


def beams_of(ranges: np.ndarray, scanner: Scanner, points: ScanPoints) -> Beams:
    """Return the beams of (S, K) readings with these points."""
    angle = np.mod(scanner.bearings + scanner.mount[2], _FULL_TURN)
    order = np.argsort(angle, kind="stable")
    state = reading_classes(ranges, scanner.range_min, scanner.range_max)[:, order]
    scan = np.repeat(np.arange(len(ranges)), points.counts)
    bearing = angle[order]
    beam = _beams_of_points(points, bearing, scan, state)
    count = len(order)
    steps = np.mod(np.roll(bearing, -1) - bearing, _FULL_TURN)
    usual = float(np.median(steps)) if count else 0.0
    beside = steps <= _NEIGHBOURS * usual + 1e-12
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
