"""Records of logs: scans, odometry and runs among landmarks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gpusense._util import checks
from gpusense._util.typing import Floats, Integers
from gpusense.world.landmarks import LandmarkMap
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
