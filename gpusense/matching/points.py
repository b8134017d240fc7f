"""Points of scans, sorted by bearing, as the kernels of matching take them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gpusense.world.scanner import Reading, Scanner, classes
from gpusense.world.sweep import sensor_points

_FULL_TURN = 2 * math.pi
# Points nearer than this have no bearing [m].
_NEAREST = 1e-6
# Largest step between bearings that hides nothing, in steps of the scanner.
_GAP = 3.0


@dataclass(frozen=True)
class ScanPoints:
    """End points of the hits of scans, in a frame at the sensor whose axes are those of the robot.

    Attributes:
        point: (P, 4) x, y [m], bearing in [0, 2 pi) [rad] and range [m], sorted by bearing in each scan.
        start: (S + 1,) first point of each scan.
        gap: Largest step between the bearings of two neighbours that hides nothing [rad].
    """

    point: np.ndarray
    start: np.ndarray
    gap: float

    @property
    def counts(self) -> np.ndarray:
        """(S,) points of each scan."""
        return np.diff(self.start)

    def rms_range(self, scan: np.ndarray) -> np.ndarray:
        """Return the root mean square range of some scans, at least 1e-3 m."""
        squares = np.append(0, np.cumsum(self.point[:, 3].astype(np.float64) ** 2))
        sums = squares[self.start[1:]] - squares[self.start[:-1]]
        return np.maximum(np.sqrt(sums / np.maximum(self.counts, 1)), 1e-3)[scan]


def scan_points(ranges: np.ndarray, scanner: Scanner, real: np.dtype, motion: np.ndarray | None = None) -> ScanPoints:
    """Return the points of the hits of (S, K) readings.

    Args:
        ranges: Readings [m].
        scanner: The scanner; its mount's yaw is added to bearings.
        real: Precision of the points.
        motion: (S, 3) motions of the robot during the scans, see ``gpusense.world.sweep``; points are then in the
            frames at the first beams. None: the robot is at rest.
    """
    if motion is not None and motion.any():
        return _moved_points(ranges, scanner, real, motion)
    bearing = np.mod(scanner.bearings + scanner.mount[2], _FULL_TURN)
    order = np.argsort(bearing, kind="stable")
    bearing = bearing[order].astype(real)
    hit = (classes(ranges, scanner.range_min, scanner.range_max) == Reading.HIT) & (ranges > _NEAREST)
    hit = hit[:, order]
    beam = np.nonzero(hit)[1]
    z = ranges[:, order][hit].astype(np.float64)
    angle = np.mod(scanner.bearings + scanner.mount[2], _FULL_TURN)[order]
    point = np.empty((len(z), 4), real)
    point[:, 0] = z * np.cos(angle)[beam]
    point[:, 1] = z * np.sin(angle)[beam]
    point[:, 2] = bearing[beam]
    point[:, 3] = z
    return _points(point, hit, bearing)


def _moved_points(ranges: np.ndarray, scanner: Scanner, real: np.dtype, motion: np.ndarray) -> ScanPoints:
    """Return the points of scans of a robot that moves."""
    hit = (classes(ranges, scanner.range_min, scanner.range_max) == Reading.HIT) & (ranges > _NEAREST)
    place = sensor_points(ranges.astype(np.float64), scanner, motion)[hit]
    direction = np.mod(np.arctan2(place[:, 1], place[:, 0]), _FULL_TURN)
    point = np.column_stack([place, direction, np.hypot(*place.T)]).astype(real)
    order = np.lexsort((direction, np.nonzero(hit)[0]))
    return _points(point[order], hit, np.sort(np.mod(scanner.bearings, _FULL_TURN)))


def _points(point: np.ndarray, hit: np.ndarray, bearing: np.ndarray) -> ScanPoints:
    """Return points with the starts of their scans, and the gap of a scanner's ascending bearings."""
    start = np.append(0, np.cumsum(np.count_nonzero(hit, axis=1))).astype(np.int32)
    steps = np.diff(bearing.astype(np.float64))
    gap = _GAP * float(np.median(steps)) if len(steps) else _FULL_TURN
    return ScanPoints(np.ascontiguousarray(point), start, gap)
