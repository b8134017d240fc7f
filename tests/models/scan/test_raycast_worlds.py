"""``RayCaster.cast`` in worlds of every kind against walks in rational arithmetic."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
import pytest
from support.ray_oracles import Hit, Ray, backward_error_is_small, walk, world_ray
from support.raycast_scenes import (
    FLOAT32_CELLS,
    FLOAT32_MOVE,
    FLOAT32_TURN,
    PRECISIONS,
)

import gpusense as gs

WORLDS = {
    "plain": (0.05, (0.0, 0.0, 0.0)),
    "millimetres": (0.001, (0.3, -0.2, 0.0)),
    "hundred metres": (100.0, (-500.0, 900.0, 0.4)),
    "yaw": (0.05, (-3.0, 2.0, 2.5)),
}
CELLS_FAR = 30.5


@dataclass(frozen=True)
class World:
    """A grid with unknown cells, poses all around, and the exact casts."""

    grid: gs.OccupancyGrid
    poses: np.ndarray
    bearings: np.ndarray
    cells: list[list[bool]]
    rays: dict[tuple[int, int], Ray]
    exact: dict[tuple[int, int], Hit]


@functools.cache
def world(name: str, unknown: str, outside: str) -> World:
    resolution, origin = WORLDS[name]
    rng = np.random.default_rng([7, *name.encode()])
    grid = gs.OccupancyGrid(rng.choice([0, 100, -1, 40], (25, 36), p=[0.86, 0.06, 0.04, 0.04]), resolution, origin)
    x, y = (n * rng.uniform(-0.2, 1.2, 200) for n in (grid.width, grid.height))
    cos, sin = math.cos(origin[2]), math.sin(origin[2])
    theta = rng.uniform(-10, 10, 200)
    poses = np.stack([origin[0] + cos * x - sin * y, origin[1] + sin * x + cos * y, theta], axis=1)
    bearings = rng.uniform(-np.pi, np.pi, 8)
    stops = (grid.cells >= 65) | ((grid.cells < 0) & (unknown == "occupied"))
    rays = {
        (n, k): world_ray(poses[n], bearings[k], origin=origin, resolution=resolution, range_max=CELLS_FAR * resolution)
        for n, k in np.ndindex(len(poses), len(bearings))
    }
    exact = {index: walk(stops.tolist(), ray, outside == "occupied") for index, ray in rays.items()}
    return World(grid, poses, bearings, stops.tolist(), rays, exact)


@pytest.mark.long_on("warp")
@pytest.mark.sampled(0.4)
@pytest.mark.parametrize("name", WORLDS)
@pytest.mark.parametrize(("unknown", "outside"), [("free", "free"), ("occupied", "free"), ("free", "occupied")])
@pytest.mark.parametrize("precision", PRECISIONS)
def test_casts_of_a_world(name, unknown, outside, precision, backend):
    w = world(name, unknown, outside)
    resolution = w.grid.resolution
    caster = gs.RayCaster(
        w.grid, CELLS_FAR * resolution, backend=backend, precision=precision, unknown=unknown, outside=outside
    )
    found = caster.cast(w.poses, w.bearings).astype(np.float64) / resolution
    for index, ray in w.rays.items():
        hit, r = w.exact[index], found[index]
        tolerance, move, turn = FLOAT32_CELLS, FLOAT32_MOVE, FLOAT32_TURN
        if precision == "float64":
            tolerance, move, turn = forward_error(ray, hit), 1e-12, 1e-15
        assert abs(r - hit.t) <= tolerance or backward_error_is_small(
            w.cells, ray, r, move=move, turn=turn, tolerance=tolerance, outside_occupied=outside == "occupied"
        ), (index, ray, r, hit)


def forward_error(ray: Ray, exact: Hit) -> float:
    """Return float64's bound: 1e-12 of the range, and the effect of rounded poses on rays at oblique walls."""
    normal = {"x": ray.direction[0], "y": ray.direction[1]}.get(exact.face[2] if exact.face else "", 1)
    size = 2e-15 * (1 + max(abs(ray.cell[0]), abs(ray.cell[1])))
    return 1e-12 * exact.t + (size + 1e-15 * exact.t) / max(abs(float(normal)), 1e-12)


@pytest.mark.parametrize("theta", [1e6, -1e6, 123456.789])
def test_large_headings(backend, theta):
    """The heading is reduced modulo the true 2 pi, not a rounded one."""
    rng = np.random.default_rng(3)
    occupied = rng.random((30, 30)) < 0.05
    poses = np.column_stack([rng.uniform(0, 30, (100, 2)), theta + rng.uniform(-3, 3, 100)])
    grid = gs.OccupancyGrid(occupied * 100, 1.0)
    found = gs.RayCaster(grid, 40.0, backend=backend, precision="float64").cast(poses, [0.0, 1.0])
    for n, k in np.ndindex(found.shape):
        ray = world_ray(poses[n], [0.0, 1.0][k], origin=(0, 0, 0), resolution=1.0, range_max=40.0)
        exact = walk(occupied.tolist(), ray)
        assert abs(found[n, k] - exact.t) <= forward_error(ray, exact)


def test_range_max_is_returned_as_it_is(backend):
    grid = gs.OccupancyGrid(np.zeros((4, 4), int), 0.3)
    for range_max in (0.7, 30.1, 1e-3):
        for precision in PRECISIONS:
            caster = gs.RayCaster(grid, range_max, backend=backend, precision=precision)
            found = caster.cast([[0.5, 0.5, 0.3], [-50.0, 3.0, 0.0]], np.linspace(-3, 3, 9))
            assert (found == np.dtype(precision).type(range_max)).all()
