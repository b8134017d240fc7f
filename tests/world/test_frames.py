"""Poses in a grid's frame, against 60 digits."""

from __future__ import annotations

import math

import mpmath as mp
import numpy as np
import pytest
from support.oracles import placed

import gpusense as gs
from gpusense.world.frames import place_poses, ray_vectors, split

FLOAT64, FLOAT32 = np.dtype(np.float64), np.dtype(np.float32)
NO_MOUNT = (0.0, 0.0, 0.0)
# The largest error of a number below 1 as the sum of two rounded ones.
TWO_PARTS = {"float64": 0.0, "float32": 2.0**-48}

FRAMES = {
    "plain": (0.05, (0.0, 0.0, 0.0), NO_MOUNT),
    "yaw": (0.05, (-12.3, 4.5, 1.1), NO_MOUNT),
    "mount": (0.1, (2.0, -1.0, -2.9), (0.4, -0.3, 0.8)),
    "millimetres": (0.001, (0.1, 0.2, 0.3), (0.01, 0.02, 0.0)),
    "hundred metres": (100.0, (1e4, -1e4, 6.0), NO_MOUNT),
    "far away": (0.05, (4.5e5, 5e6, 0.0), NO_MOUNT),
    "far away with yaw": (0.05, (-4.5e5, 5e6, 2.0), (0.3, 0.1, 0.0)),
}


def poses_around(origin, resolution: float, count: int = 200) -> np.ndarray:
    """Return poses up to 3000 cells from a grid's origin, with all kinds of headings."""
    rng = np.random.default_rng(1)
    xy = np.array(origin[:2]) + rng.uniform(-3000, 3000, (count, 2)) * resolution
    theta = rng.uniform(-7, 7, count)
    theta[:8] = [0.0, -0.0, math.pi, -math.pi, 1e6, -1e6, 2 * math.pi, 123456.789]
    return np.column_stack([xy, theta])


@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize("name", FRAMES)
def test_cell_fraction_and_low_part_make_the_position(name, precision):
    resolution, origin, mount = FRAMES[name]
    real = np.dtype(precision)
    grid = gs.OccupancyGrid(np.zeros((4, 5), int), resolution, origin)
    poses = poses_around(origin, resolution)
    found = place_poses(poses, grid, mount, real)
    assert found.cell.dtype == np.int32 and found.pose.dtype == found.low.dtype == real
    assert found.cell.shape == (200, 2) and found.pose.shape == found.low.shape == (200, 4)
    assert ((found.pose[:, :2] >= 0) & (found.pose[:, :2] < 1)).all()
    # The pose minus the origin is exact to half an ulp of 3000 cells in float64.
    cells = 3000 + math.hypot(*mount[:2]) / resolution
    position = 1e-12 + 8 * np.finfo(float).eps * cells
    heading = 4 * np.finfo(float).eps + TWO_PARTS[precision]
    for pose, cell, high, low in zip(poses, found.cell, found.pose, found.low, strict=True):
        x, y, cos, sin = placed(pose, origin, resolution, mount)
        for exact, whole, h, rest in ((x, cell[0], high[0], low[0]), (y, cell[1], high[1], low[1])):
            assert abs(int(whole) + mp.mpf(float(h)) + mp.mpf(float(rest)) - exact) <= position
        for exact, h, rest in ((cos, high[2], low[2]), (sin, high[3], low[3])):
            assert abs(mp.mpf(float(h)) + mp.mpf(float(rest)) - exact) <= heading
            assert abs(mp.mpf(float(h)) - exact) <= np.finfo(real).eps


@pytest.mark.parametrize("real", [FLOAT64, FLOAT32], ids=str)
def test_fractions_that_round_to_one(real):
    """Just below an edge, a pose keeps its cell and a fraction below 1."""
    grid = gs.OccupancyGrid(np.zeros((4, 4), int), 1.0)
    for x in (np.nextafter(2.0, 0), 2 - 1e-9, 2 - 2.0**-25, 1 - 2.0**-53, 0.0, 2.0, 3 + 2.0**-30):
        found = place_poses(np.array([[x, x, 0.0]]), grid, NO_MOUNT, real)
        assert found.cell.tolist() == [[math.floor(x)] * 2]
        assert (found.pose[0, :2] < 1).all()
        total = found.cell[0] + found.pose[0, :2].astype(float) + found.low[0, :2]
        np.testing.assert_allclose(total, [x, x], rtol=0, atol=TWO_PARTS[real.name])


@pytest.mark.parametrize("real", [FLOAT64, FLOAT32], ids=str)
@pytest.mark.parametrize("x", [-1e-20, -5e-324, -1e-17, -3e-17])
def test_just_below_zero(real, x):
    """The cell is -1; the fraction alone does not resolve its distance from 1, but high and low part do."""
    grid = gs.OccupancyGrid(np.zeros((4, 4), int), 1.0)
    found = place_poses(np.array([[x, 0.5, 0.0]]), grid, NO_MOUNT, real)
    assert found.cell.tolist() == [[-1, 0]]
    assert found.pose[0, 0] == np.nextafter(real.type(1), real.type(0))
    assert found.cell[0, 0] + float(found.pose[0, 0]) + float(found.low[0, 0]) == pytest.approx(
        x, abs=2e-16 + TWO_PARTS[real.name]
    )


@pytest.mark.parametrize("yaw", [0.0, 0.7, -3.0, 1e6])
def test_ray_vectors(yaw):
    bearings = np.array([0.0, 1.0, -2.0, math.pi, 1e5, -1e6])
    found = ray_vectors(bearings, (0.3, 0.4, yaw))
    for bearing, (cos, sin) in zip(bearings, found, strict=True):
        exact = mp.mpf(float(bearing)) + mp.mpf(yaw)
        # The sum of two angles is rounded once, which turns large ones by half an ulp.
        slack = 2.3e-16 + np.spacing(abs(bearing) + abs(yaw)) / 2
        assert abs(mp.mpf(float(cos)) - mp.cos(exact)) <= slack
        assert abs(mp.mpf(float(sin)) - mp.sin(exact)) <= slack


def test_split_keeps_48_bits():
    values = np.random.default_rng(0).uniform(-1e6, 1e6, 1000)
    high, low = split(values, FLOAT32)
    assert (np.abs(high.astype(float) + low - values) <= 2.0**-48 * np.abs(values)).all()
    high, low = split(values, FLOAT64)
    assert (high == values).all() and not low.any()
