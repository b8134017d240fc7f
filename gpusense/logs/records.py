"""Records of logs: scans, odometry, runs among landmarks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gpusense.world.landmarks import LandmarkMap
from gpusense.world.scanner import Scanner

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Pose = tuple[float, float, float]
"""(x, y, theta) [m, m, rad]."""


@dataclass(frozen=True, eq=False)
class Scan:
    """One scan of a laser range finder."""

    time: float
    """When it was measured, by the log's clock [s]."""
    ranges: NDArray[np.float64]
    """(K,) readings [m]; read-only. :func:`gpusense.world.scanner.classify` tells what they mean."""
    scanner: Scanner
    """The geometry; one object for all scans of the same geometry."""
    odometry: Pose
    """The robot's pose in the odometry frame."""
    pose: Pose | None
    """The laser's corrected pose in the world, or None where the log has none."""


@dataclass(frozen=True)
class Odometry:
    """One reading of the wheel odometry."""

    time: float
    """When it was measured, by the log's clock [s]."""
    pose: Pose
    """The robot's pose in the odometry frame."""


@dataclass(frozen=True, eq=False)
class LandmarkRun:
    """S scans with F features, in the order of time.

    Attributes:
        landmarks: The map.
        labels: (M,) what the recording calls them.
        time: (S,) of the scans [s].
        odometry: (S, 3) poses by odometry alone, in its own frame [m, m, rad].
        truth: (S, 3) logged poses in the world.
        features: (F, 2) ranges [m] and bearings [rad].
        scan: (F,) scan of each, ascending.
        ids: (F,) landmark that the recording says each is.
        range_max: Largest range that the sensor can have [m].
        field_of_view: Angle in which it sees [rad].
        left_out: Readings that are no feature of the map, by what they are.
    """

    landmarks: LandmarkMap
    labels: Integers
    time: Floats
    odometry: Floats
    truth: Floats
    features: Floats
    scan: Integers
    ids: Integers
    range_max: float
    field_of_view: float
    left_out: dict[str, int]

    @property
    def poses(self) -> Floats:
        """(F, 3) logged pose of each feature."""
        return self.truth[self.scan]
