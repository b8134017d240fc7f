"""Convert a transform to a laser's mount, and check a mount against data."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from gpusense._util import checks
from gpusense._util.angles import wrapped
from gpusense._util.typing import Floats
from gpusense.logs.records import Pose, Scan
from gpusense.world.messages import tilt_of

# Least tilt of a laser whose beams run clockwise [rad].
_UPSIDE_DOWN = 2 * math.pi / 3
# Check of a mount: number of headings, most pairs of scans, distance and turn between the scans of a pair.
_HEADINGS, _PAIRS = 24, 12
_SHIFT, _TURN = (0.15, 1.0), 0.2


def planar(matrix: Floats) -> Pose:
    """Return (x, y, yaw) of a (4, 4) pose."""
    return float(matrix[0, 3]), float(matrix[1, 3]), math.atan2(matrix[1, 0], matrix[0, 0])


def planar_mount(matrix: Floats) -> tuple[Pose, bool, float]:
    """Return a laser's mount, whether it is upside down (with clockwise bearings), and its tilt [rad]."""
    tilt = tilt_of(matrix)
    upside_down = tilt > _UPSIDE_DOWN
    return planar(matrix), upside_down, math.pi - tilt if upside_down else tilt


def check_mount(scans: Sequence[Scan]) -> str | None:
    """Describe how the scans of a moving robot contradict their scanner's mount; None if they agree with it.

    Odometry overlays pairs of scans between which the robot drove without much turning, for 24 headings of the laser.
    The mount contradicts the data if another heading brings end points at least twice as close, and within 5 cm in the
    median. The laser's position is not checked.

    Args:
        scans: Scans in the order of time, with odometry.

    Raises:
        TypeError: ``scans`` does not hold scans.

    Example:
        >>> import gpusense as gs
        >>> gs.check_mount([]) is None
        True
    """
    if not isinstance(scans, (list, tuple)):
        raise TypeError(f"scans: must be a list of Scan, got {checks.show(scans)}")
    for scan in scans:
        checks.instance("scans", scan, Scan)
    pairs = _pairs(scans)
    if len(pairs) < 3:
        return None
    turns = 2 * math.pi * np.arange(_HEADINGS) / _HEADINGS
    gaps = np.array([np.median([_gap(first, second, turn) for first, second in pairs]) for turn in turns])
    best = int(np.argmin(gaps))
    given = scans[0].scanner.mount[2]
    better = math.remainder(given + turns[best], 2 * math.pi)
    if best == 0 or gaps[best] > 0.5 * gaps[0] or gaps[best] > 0.05:
        return None
    return (
        f"the laser's heading on the robot seems to be {math.degrees(better):.0f} deg, not "
        f"{math.degrees(given):.0f} deg: then end points of {len(pairs)} pairs of scans are "
        f"{1000 * gaps[best]:.0f} mm apart, not {1000 * gaps[0]:.0f} mm"
    )


def _pairs(scans: Sequence[Scan]) -> list[tuple[Scan, Scan]]:
    """Return pairs of scans of nearly the same heading, the second some distance ahead of the first."""
    pairs, first = [], 0
    for k in range(1, len(scans)):
        x, y, theta = np.subtract(scans[k].odometry, scans[first].odometry)
        turn = abs(wrapped(theta))
        if turn > _TURN or math.hypot(x, y) > _SHIFT[1]:
            first = k
        elif math.hypot(x, y) >= _SHIFT[0]:
            pairs.append((scans[first], scans[k]))
            first = k
    return pairs[:: max(1, len(pairs) // _PAIRS)]


def _gap(first: Scan, second: Scan, turn: float) -> float:
    """Return the median distance of the second scan's end points from the first scan's, by odometry."""
    from scipy.spatial import KDTree

    points = [_end_points(scan, turn) for scan in (first, second)]
    if min(map(len, points)) < 10:
        return math.inf
    return float(np.median(KDTree(points[0]).query(points[1])[0]))


def _end_points(scan: Scan, turn: float) -> Floats:
    """Return end points of the hits in the odometry frame, for a laser turned by ``turn`` on the robot."""
    scanner = scan.scanner
    hit = np.isfinite(scan.ranges) & (scan.ranges > max(scanner.range_min, 0.05)) & (scan.ranges < scanner.range_max)
    x, y, theta = scanner.mount
    angle = scanner.bearings[hit] + theta + turn
    on_robot = np.stack([x + scan.ranges[hit] * np.cos(angle), y + scan.ranges[hit] * np.sin(angle)])
    c, s = math.cos(scan.odometry[2]), math.sin(scan.odometry[2])
    return (np.array([[c, -s], [s, c]]) @ on_robot).T + scan.odometry[:2]
