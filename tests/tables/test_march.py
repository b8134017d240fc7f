"""Marching through the distance field: its errors by tolerance, rule and distance, and its steps."""

from __future__ import annotations

import math

import numpy as np
import pytest

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.interface.structs import Window
from gpusense.reference import march as march_reference
from gpusense.tables.casters import CasterInput, March

LEAST_PART = 2.0**-22


def scattered(seed: int, density: float = 0.03) -> tuple[gs.OccupancyGrid, np.ndarray]:
    """Return single obstacles, all corners, in cells of 1 m, and 60 poses in free cells."""
    rng = np.random.default_rng(seed)
    cells = np.where(rng.random((50, 60)) < density, 100, 0)
    grid = gs.OccupancyGrid(cells, 1.0)
    xy = rng.uniform((0, 0), (60, 50), (400, 2))
    xy = xy[cells[xy[:, 1].astype(int), xy[:, 0].astype(int)] == 0][:60]
    return grid, np.column_stack([xy, rng.uniform(-np.pi, np.pi, 60)])


def passages(occupied: np.ndarray, x: float, y: float, angle: float, limit: float) -> np.ndarray:
    """Return (M, 2) places where a ray enters and leaves obstacles, by cutting it at all lines of the lattice."""
    dx, dy = math.cos(angle), math.sin(angle)
    cuts = [(np.arange(-90, 150) - start) / speed for start, speed in ((x, dx), (y, dy))]
    t = np.unique(np.clip(np.concatenate([*cuts, [0, limit]]), 0, limit))
    middle = (t[1:] + t[:-1]) / 2
    col, row = np.floor(x + middle * dx).astype(int), np.floor(y + middle * dy).astype(int)
    inside = (col >= 0) & (row >= 0) & (col < occupied.shape[1]) & (row < occupied.shape[0])
    hit = np.zeros(len(middle) + 2, int)
    hit[1:-1] = inside & occupied[np.where(inside, row, 0), np.where(inside, col, 0)]
    edges = np.diff(hit)
    return np.column_stack([t[edges == 1], t[edges == -1]])


@pytest.mark.parametrize("tolerance", [1.0, 0.1, 0.01])
def test_marching_is_too_long_by_the_tolerance_or_clips_less_of_a_corner(tolerance, backend):
    """Each ray passes through obstacles for less than the smallest step, and stops less than that before one."""
    bearings, limit, clipped = np.linspace(0, 6, 7), 40.0, 0
    grid, poses = scattered(2)
    rays = [passages(grid.occupied, x, y, theta + b, limit) for x, y, theta in poses for b in bearings]
    for precision, rounding in (("float64", 1e-9), ("float32", 1e-3)):
        caster = gs.RayCaster(grid, limit, method=March(tolerance), backend=backend, precision=precision)
        for ranges, found in zip(rays, caster.cast(poses, bearings).ravel().astype(float), strict=True):
            least = tolerance + LEAST_PART * limit + rounding
            passed = ranges[ranges[:, 0] + least < found]
            assert (passed[:, 1] - passed[:, 0] <= least).all(), (ranges, found)
            clipped += len(passed) > 0
            if found < limit:
                assert ((ranges[:, 0] - rounding <= found) & (found <= ranges[:, 0] + least)).any(), (ranges, found)
    # The number of rays of this map that pass a corner within this distance.
    assert clipped <= 0.3 * tolerance * 2 * len(rays) + 2


class Counting:
    """A table that counts its look-ups."""

    def __init__(self, table: np.ndarray) -> None:
        self.table, self.count = table, 0

    def __getitem__(self, index: np.ndarray) -> np.ndarray:
        self.count += len(index)
        return self.table[index]


def steps(grid: gs.OccupancyGrid, poses: np.ndarray, kind: March, limit: float) -> int:
    """Return the look-ups of the reference, a ray along each pose's heading."""
    table = Counting(kind.prepare(get_backend("numpy"), CasterInput(grid.occupied, limit, "free")).buffer)
    cell = np.floor(poses[:, :2])
    pose = np.column_stack([poses[:, :2] - cell, np.cos(poses[:, 2]), np.sin(poses[:, 2])])
    ahead, window = np.tile([1.0, 0.0], (len(pose), 1)), Window(0, 0, *grid.shape)
    march_reference.cast_ray(frozenset({"FLOAT64"}), table, window, cell.astype(int), pose, ahead, limit, kind.struct())
    return table.count


def test_the_rule_centre_takes_fewer_steps_and_errs_more():
    for seed in range(4):
        grid, poses = scattered(seed)
        exact = gs.RayCaster(grid, 40.0, backend="numpy").cast(poses, [0.0])
        errors, counts = [], []
        for rule in ("safe", "centre"):
            found = gs.RayCaster(grid, 40.0, method=March(0.1, rule), backend="numpy").cast(poses, [0.0])
            errors.append(np.abs(found - exact).mean())
            counts.append(steps(grid, poses, March(0.1, rule), 40.0))
        assert errors[1] > errors[0] and counts[1] < 0.7 * counts[0]


@pytest.mark.long
def test_a_march_of_a_million_cells_ends(backend):
    """There the tolerance is below the spacing of float32 numbers, and a step must still advance."""
    cells = np.zeros((3, 60), int)
    cells[[0, 2]] = cells[1, -1] = 100
    caster = gs.RayCaster(gs.OccupancyGrid(cells, 1.0), 1_040_000, method=March(0.001), backend=backend)
    for far in (1e3, 1e5, 1e6):
        found = caster.cast([[-far, 1.5, 0.0]], [0.0])[0, 0] - far
        assert -far * 2.0**-23 <= found - 59 <= 0.001 + 2 * far * LEAST_PART
