"""Locate antennas on robots at known poses."""

from __future__ import annotations

import numpy as np

from gpusense._util import checks
from gpusense.learning.point.problem import Floats


def places_of(poses: Floats, mount: object) -> Floats:
    """Return the (S, 2) positions in the world of a point (x, y) on the robot at (S, 3) poses."""
    x, y = checks.array("mount", mount, (2,), largest=checks.FARTHEST)
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    return poses[:, :2] + np.stack([c * x - s * y, s * x + c * y], axis=1)
