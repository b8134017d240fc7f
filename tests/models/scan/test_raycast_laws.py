"""Laws of the exact caster that need no oracle: turned, mirrored and shifted maps, and more walls."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.ray_oracles import backward_error_is_small, world_ray
from support.raycast_scenes import PRECISIONS

import gpusense as gs

MAPS = st.integers(0, 2**32 - 1)
LAWS = settings(
    max_examples=25, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def drawn(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw a map, poses off its lattice, and bearings."""
    rng = np.random.default_rng(seed)
    cells = np.where(rng.random(rng.integers(1, 25, 2)) < rng.choice([0.02, 0.1]), 100, 0)
    poses = np.column_stack([*(rng.uniform(-2, n + 2, 12) for n in cells.shape[::-1]), rng.uniform(-4, 4, 12)])
    return cells, poses, rng.uniform(-np.pi, np.pi, 6)


def ranges(cells, poses, bearings, backend, origin=(0.0, 0.0, 0.0), resolution=1.0) -> np.ndarray:
    grid = gs.OccupancyGrid(cells, resolution, origin)
    return gs.RayCaster(grid, 30.0 * resolution, backend=backend, precision="float64").cast(poses, bearings)


@LAWS
@given(MAPS)
def test_turning_map_and_poses_by_a_right_angle(backend, seed):
    cells, poses, bearings = drawn(seed)
    turned = np.column_stack([cells.shape[0] - poses[:, 1], poses[:, 0], poses[:, 2] + np.pi / 2])
    found = ranges(np.rot90(cells, -1), turned, bearings, backend)
    np.testing.assert_allclose(found, ranges(cells, poses, bearings, backend), rtol=1e-9, atol=1e-9)


@LAWS
@given(MAPS, st.floats(-7, 7), st.sampled_from([0.0, 1e3, 5e6]))
def test_turning_map_and_poses_by_the_yaw_of_the_origin(backend, seed, yaw, far):
    cells, poses, bearings = drawn(seed)
    cos, sin, (x, y, theta) = math.cos(yaw), math.sin(yaw), poses.T
    origin = (far, -far, yaw)
    moved = np.column_stack([origin[0] + cos * x - sin * y, origin[1] + sin * x + cos * y, theta + yaw])
    found = ranges(cells, moved, bearings, backend, origin)
    close = 1e-9 if far == 0 else 1e-5
    wrong = np.abs(found - ranges(cells, poses, bearings, backend)) > close
    assert not wrong.any() or (far > 0 and all_backward(cells, poses, bearings, found, wrong, 1e-8 if far else 0))


def all_backward(cells, poses, bearings, found, wrong, move) -> bool:
    return all(
        backward_error_is_small(
            (cells >= 65).tolist(),
            world_ray(poses[n], bearings[k], origin=(0, 0, 0), resolution=1.0, range_max=30.0),
            found[n, k],
            move=move,
            turn=1e-12,
            tolerance=1e-6,
        )
        for n, k in np.argwhere(wrong)
    )


@LAWS
@given(MAPS)
def test_mirror(backend, seed):
    cells, poses, bearings = drawn(seed)
    mirrored = poses * [1, -1, -1] + [0, cells.shape[0], 0]
    found = ranges(cells[::-1], mirrored, -bearings, backend)
    np.testing.assert_allclose(found, ranges(cells, poses, bearings, backend), rtol=1e-9, atol=1e-9)


@LAWS
@given(MAPS, st.integers(0, 300), st.integers(0, 300))
def test_shift(backend, seed, dx, dy):
    """A wider map of free cells around the same walls, the origin moved accordingly."""
    cells, poses, bearings = drawn(seed)
    wide = np.pad(cells, ((dy, 3), (dx, 5)))
    found = ranges(wide, poses + np.array([dx, dy, 0]), bearings, backend)
    np.testing.assert_allclose(found, ranges(cells, poses, bearings, backend), rtol=1e-9, atol=1e-9)
    found = ranges(wide, poses, bearings, backend, origin=(-dx, -dy, 0.0))
    np.testing.assert_allclose(found, ranges(cells, poses, bearings, backend), rtol=1e-9, atol=1e-9)


@LAWS
@given(MAPS, st.sampled_from(PRECISIONS), st.booleans())
def test_a_wall_lengthens_no_range(backend, seed, precision, on_lattice):
    """An additional wall leaves a ray exactly equal or shortens it."""
    cells, poses, bearings = drawn(seed)
    if on_lattice:
        poses, bearings = np.round(poses * 4) / 4, np.arange(8) * (np.pi / 4)
    rng = np.random.default_rng(seed)
    more = cells.copy()
    more[tuple(rng.integers(0, n) for n in cells.shape)] = 100
    before, after = (
        gs.RayCaster(gs.OccupancyGrid(c, 1.0), 30.0, backend=backend, precision=precision).cast(poses, bearings)
        for c in (cells, more)
    )
    assert (after <= before).all()


@LAWS
@given(MAPS, st.integers(-3, 3))
def test_whole_turns_do_not_matter(backend, seed, turns):
    cells, poses, bearings = drawn(seed)
    found = ranges(cells, poses + np.array([0, 0, 2 * np.pi * turns]), bearings, backend)
    np.testing.assert_allclose(found, ranges(cells, poses, bearings, backend), rtol=1e-9, atol=1e-9)
