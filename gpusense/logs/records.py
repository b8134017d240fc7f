"""Records of logs: scans, odometry and runs among landmarks; mounts by transforms, and checks of a mount."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpusense._util import checks
from gpusense._util.angles import wrapped
from gpusense._util.typing import Floats, Integers
from gpusense.world.frames import ray_vectors
from gpusense.world.landmarks import LandmarkMap
from gpusense.world.messages import tilt_of
from gpusense.world.pose_algebra import rotated
from gpusense.world.scanner import Scanner

Pose = tuple[float, float, float]
"""(x, y, theta) [m, m, rad]."""


@dataclass(frozen=True, eq=False)
class Scan:
    """One scan of a laser range finder.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> gs.Scan(12.5, np.ones(3), gs.Scanner([-0.5, 0, 0.5], range_max=8.0), (0.0, 0.0, 0.0), None)
        Scan(time=12.5, 3 readings, odometry=(0.0, 0.0, 0.0), pose=None)
    """

    time: float
    """Time of measurement by the log's clock [s]."""
    ranges: NDArray[np.float64]
    """(K,) readings [m], NaN where masked; read-only. :func:`gpusense.classify` classifies them."""
    scanner: Scanner
    """The geometry; scans of one geometry share an object."""
    odometry: Pose
    """The robot's pose in the odometry frame [m, m, rad]."""
    pose: Pose | None
    """The robot's corrected pose in the world [m, m, rad], or the laser's in a CARMEN log; None if unknown."""
    duration: float = 0.0
    """Time from the first beam to the last one [s]; 0 if the log does not state it."""

    intensities: NDArray[np.float32] | None = None
    """(K,) intensities of the readings in the scanner's unit, read-only; None if the log has none."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "ranges", checks.filled(self.ranges))

    def __repr__(self) -> str:
        return f"Scan(time={self.time}, {len(self.ranges)} readings, odometry={self.odometry}, pose={self.pose})"


def check_scanner(scan: Scan, scanner: Scanner, where: str) -> None:
    """Check that a scan of a log has the scanner of the previous scans."""
    if scan.scanner != scanner:
        remedy = ""
        if scan.scanner.mount != scanner.mount:
            mounts = " and ".join(f"({', '.join(f'{x:.4g}' for x in each.mount)})" for each in (scanner, scan.scanner))
            remedy = f", with mounts {mounts}: --frame chooses one laser, --mount sets one mount"
        raise ValueError(f"log: every scan must come from the same scanner, got another at {where}{remedy}")


@dataclass(frozen=True)
class Odometry:
    """One reading of the wheel odometry.

    Example:
        >>> import gpusense as gs
        >>> gs.Odometry(12.5, (0.1, 0.0, 0.0)).pose
        (0.1, 0.0, 0.0)
    """

    time: float
    """Time of measurement by the log's clock [s]."""
    pose: Pose
    """The robot's pose in the odometry frame [m, m, rad]."""


@dataclass(frozen=True, eq=False)
class LandmarkRun:
    """A run among landmarks: S scans with F features, in the order of time."""

    landmarks: LandmarkMap
    labels: Integers  # (M,) labels of the landmarks in the recording
    time: Floats  # (S,) times of the scans [s]
    odometry: Floats  # (S, 3) poses by odometry, in the odometry frame [m, m, rad]
    truth: Floats  # (S, 3) logged poses in the world [m, m, rad]
    features: Floats  # (F, 2) ranges [m] and bearings [rad]
    scan: Integers  # (F,) scan of each feature, ascending
    ids: Integers  # (F,) landmark of each feature according to the recording
    range_max: float  # largest range of the sensor [m]
    field_of_view: float  # field of view of the sensor [rad]
    left_out: dict[str, int]  # numbers of readings without a landmark of the map, by reason

    @property
    def poses(self) -> Floats:
        """(F, 3) logged pose of each feature."""
        return self.truth[self.scan]

    def __repr__(self) -> str:
        return f"LandmarkRun({len(self.time)} scans, {len(self.features)} features, {len(self.landmarks)} landmarks)"


def quaternion_of(yaw: float) -> dict[str, float]:
    """Return the fields of geometry_msgs/Quaternion for a rotation about z."""
    return {"x": 0.0, "y": 0.0, "z": math.sin(yaw / 2), "w": math.cos(yaw / 2)}


def pose_fields(pose: Pose) -> dict[str, Any]:
    """Return the fields of geometry_msgs/Pose."""
    return {"position": {"x": pose[0], "y": pose[1], "z": 0.0}, "orientation": quaternion_of(pose[2])}


def transform_fields(pose: Pose) -> dict[str, Any]:
    """Return the fields of geometry_msgs/Transform."""
    return {"translation": {"x": pose[0], "y": pose[1], "z": 0.0}, "rotation": quaternion_of(pose[2])}


def even_bearings(scanner: Scanner, kind: str) -> tuple[float, float]:
    """Return the first bearing and the step between bearings [rad], which must be even in a message of a kind."""
    bearings = scanner.bearings
    first = float(bearings[0]) if len(bearings) else 0.0
    step = (float(bearings[-1]) - first) / max(len(bearings) - 1, 1) if len(bearings) else 0.0
    if np.abs(bearings - (first + step * np.arange(len(bearings)))).max(initial=0.0) > _EVEN:
        raise ValueError(f"bearings: must have even steps in {kind}, got uneven ones")
    return first, step


# Largest deviation of bearings from even steps [rad].
_EVEN = 1e-9
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
    on_robot = scan.ranges[hit, None] * ray_vectors(scanner.bearings[hit], (x, y, theta + turn)) + (x, y)
    return rotated(on_robot, scan.odometry[2]) + scan.odometry[:2]
