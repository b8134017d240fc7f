"""Compare the placed origin of a sensor with 50 digits; the bound has terms of distances and of the fraction."""

from __future__ import annotations

import math

import mpmath
import numpy as np
import pytest

import gpusense as gs
from gpusense.world.frames import place_poses

UNIT = 2.0**-53


def exact_place(pose: np.ndarray, grid: gs.OccupancyGrid, mount: tuple[float, float, float]) -> list[mpmath.mpf]:
    """Return column and row coordinates of a sensor, of the numbers as given."""
    x, y, theta = (mpmath.mpf(float(value)) for value in pose)
    ox, oy, yaw = (mpmath.mpf(value) for value in grid.origin)
    mx, my = (mpmath.mpf(value) for value in mount[:2])
    east = x - ox + mpmath.cos(theta) * mx - mpmath.sin(theta) * my
    north = y - oy + mpmath.sin(theta) * mx + mpmath.cos(theta) * my
    cos, sin, side = mpmath.cos(yaw), mpmath.sin(yaw), mpmath.mpf(grid.resolution)
    return [(cos * east + sin * north) / side, (cos * north - sin * east) / side]


@pytest.mark.parametrize("real", [np.float64, np.float32])
@pytest.mark.parametrize("far", [0.0, 5e6, 1e9])
def test_the_placed_origin_is_within_its_bound(far, real, record_property):
    rng, largest = np.random.default_rng(int(far) + 1), 0.0
    last = 2.0**-53 if real is np.float64 else 2.0**-24
    for _ in range(40):
        origin = (*(far * rng.uniform(-1, 1, 2)), rng.uniform(-4, 4))
        grid = gs.OccupancyGrid(np.zeros((3, 3), int), 10.0 ** rng.uniform(-2, 0), origin)
        mount = (*(10.0 ** rng.uniform(-2, 1) * rng.uniform(-1, 1, 2)), 0.3)
        reach = 10.0 ** rng.uniform(-2, 4)
        poses = np.column_stack([np.array(origin[:2]) + rng.uniform(-reach, reach, (8, 2)), rng.uniform(-1e6, 1e6, 8)])
        placed = place_poses(poses, grid, mount, np.dtype(real))
        with mpmath.workdps(50):
            for pose, cell, fraction in zip(poses, placed.cell, placed.pose, strict=True):
                lengths = math.dist(pose[:2], origin[:2]) + math.hypot(*mount[:2])
                bound = 12 * UNIT * lengths / grid.resolution + last
                for axis, value in enumerate(exact_place(pose, grid, mount)):
                    error = abs(int(cell[axis]) + mpmath.mpf(float(fraction[axis])) - value)
                    largest = max(largest, float(error / bound))
    record_property("largest error, in bounds", largest)
    # The bound is not far above the errors that occur.
    assert 0.05 < largest <= 1
