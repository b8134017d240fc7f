"""The frame of a grid: its origin in the world and the side of its cells."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gpusense._util import checks

SMALLEST_RESOLUTION, LARGEST_RESOLUTION = 1e-4, 1e3
"""Bounds of the side of a cell [m]."""
FARTHEST_ORIGIN = 1e9
"""Largest coordinate of a map's origin [m]."""


class GridFrame(NamedTuple):
    """Frame of a grid."""

    resolution: float  # side of a cell [m]
    origin: tuple[float, float, float]  # pose (x, y, yaw) of the outer corner of cell (0, 0) in the world [m, m, rad]

    def to_cells(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert (M, 2) points in the world [m] to column and row coordinates [cells], all in float64.

        A point is taken relative to the origin, rotated by -yaw and divided by the resolution. A yaw of exactly 0 skips
        the rotation.
        """
        x, y, yaw = self.origin
        u, v = points[:, 0] - x, points[:, 1] - y
        if yaw != 0.0:
            c, s = math.cos(yaw), math.sin(yaw)
            u, v = c * u + s * v, c * v - s * u
        return np.stack([u, v], axis=1) / self.resolution

    def to_world(self, local: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert (M, 2) points in the grid's frame to the world [m]."""
        x, y, yaw = self.origin
        u, v = local[:, 0], local[:, 1]
        if yaw != 0.0:
            c, s = math.cos(yaw), math.sin(yaw)
            u, v = c * u - s * v, s * u + c * v
        return np.stack([u + x, v + y], axis=1)


def check_resolution(value: object) -> float:
    """Return the side of a cell after checking its bounds [m]."""
    return checks.real("resolution", value, low=SMALLEST_RESOLUTION, high=LARGEST_RESOLUTION)


def check_origin(value: object) -> tuple[float, float, float]:
    """Return the pose of a map after checking it [m, m, rad]."""
    x, y, yaw = checks.array("origin", value, (3,)).tolist()
    for index, coordinate in enumerate((x, y)):
        checks.real(f"origin[{index}]", coordinate, low=-FARTHEST_ORIGIN, high=FARTHEST_ORIGIN)
    return x, y, yaw
