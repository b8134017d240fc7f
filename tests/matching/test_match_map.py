"""Local maps in global ones: with and without a guess, other resolutions and frames, symmetrical and foreign maps."""

from __future__ import annotations

import math

import numpy as np
import pytest

import gpusense as gs


def house() -> np.ndarray:
    """Return cells of a house of three rooms with unlike furniture."""
    cells = np.pad(np.zeros((60, 90), int), 1, constant_values=100)
    cells[1:40, 30], cells[20:61, 60], cells[30, 60:80] = 100, 100, 100
    cells[10:14, 8:12], cells[45:48, 20:30], cells[12:20, 70:73], cells[50:52, 75] = 100, 100, 100, 100
    return cells


def cut(grid: gs.OccupancyGrid, pose, shape=(40, 50), resolution=0.1) -> gs.OccupancyGrid:
    """Return the part of a map under a local map at a pose in its frame."""
    local = gs.OccupancyGrid(np.zeros(shape, int), resolution, (-1.5, -2.0, 0.0))
    rows, cols = (index.ravel() for index in np.indices(shape))
    xy = local.cell_centers(rows, cols)
    world = gs.compose_poses(pose, np.column_stack([xy, np.zeros(len(xy))]))[:, :2]
    col, row = np.floor(grid.world_to_cells(world)).astype(int).T
    inside = (row >= 0) & (row < grid.shape[0]) & (col >= 0) & (col < grid.shape[1])
    cells = np.full(len(row), -1)
    cells[inside] = grid.cells[row[inside], col[inside]]
    return gs.OccupancyGrid(cells.reshape(shape), resolution, local.origin)


def off(pose, truth) -> tuple[float, float]:
    return float(np.hypot(*(np.asarray(pose) - truth)[:2])), abs(math.remainder(pose[2] - truth[2], 2 * math.pi))


@pytest.mark.parametrize("resolution", [0.1, 0.05])
def test_a_part_of_a_map_is_found(backend, resolution):
    grid = gs.OccupancyGrid(house(), 0.1, (5e5, -1e6, 0.7))
    (center,) = grid.cell_centers([25], [35])
    truth = np.array([*center + np.array([0.037, -0.021]), 1.113])
    local = cut(grid, truth, (round(4 / resolution), round(5 / resolution)), resolution)
    everywhere = gs.match_map(local, grid, angle=0.05, backend=backend)
    near = gs.match_map(local, grid, guess=truth + np.array([0.3, -0.4, 0.15]), window=(0.5, 0.5, 0.2), backend=backend)
    for match in (everywhere, near):
        position, heading = off(match.pose, truth)
        assert match.status == "found" and match.found
        # A tenth of a cell: the local map's cells are samples of the global one's at their centres.
        assert position < 0.01 and heading < 0.003
        assert match.correlation > 0.5 and match.overlap > 0.7
        assert match.evaluated < match.poses
    assert near.poses < everywhere.poses


@pytest.mark.parametrize("moved", [(0.03, -0.04, 0.0), (0.05, 0.05, 0.004), (-0.012, 0.001, -0.008)])
def test_a_guess_between_cells_is_aligned(moved):
    """The cells of both maps coincide; the cells searched around the guess do not."""
    grid = gs.OccupancyGrid(house(), 0.1, (2.0, 1.0, 0.3))
    local = gs.OccupancyGrid(grid.cells[5:45, 10:60], 0.1)
    truth = np.array([*grid.cell_centers([4, 5], [9, 10]).mean(axis=0), 0.3])
    match = gs.match_map(local, grid, guess=truth + moved, window=(0.2, 0.2, 0.05), backend="numpy")
    position, heading = off(match.pose, truth)
    assert position < 1e-3 and heading < 1e-4


def test_a_symmetrical_map_is_ambiguous():
    grid = gs.OccupancyGrid(np.pad(np.zeros((41, 61), int), 1, constant_values=100), 0.1)
    match = gs.match_map(grid, grid, angle=0.1, backend="numpy")
    assert match.status == "ambiguous" and len(match.modes) >= 2
    found = [min(off(mode, truth)[0] for mode in match.modes) for truth in ((0, 0, 0), (6.3, 4.3, math.pi))]
    assert max(found) < 0.15


def test_a_foreign_map_has_no_match():
    grid = gs.OccupancyGrid(house(), 0.1)
    cells = np.where(np.random.default_rng(1).random((30, 30)) < 0.3, 100, 0)
    match = gs.match_map(gs.OccupancyGrid(cells, 0.1), grid, angle=0.2, backend="numpy")
    assert match.status == "no match" and not match.found


def test_bad_arguments_are_named():
    grid = gs.OccupancyGrid(house(), 0.1)
    empty = gs.OccupancyGrid([[0]], 0.1)
    for call, name in [
        (lambda: gs.match_map(empty, grid), "local_grid"),
        (lambda: gs.match_map(grid, grid, window=(1, 1, 1)), "window"),
        (lambda: gs.match_map(grid, grid, (0, 0, 0), (-1, 1, 1)), "window"),
        (lambda: gs.match_map(grid, grid, (0, 0)), "guess"),
        (lambda: gs.match_map(grid, grid, angle=0), "angle"),
        (lambda: gs.match_map(grid, grid, min_correlation=2), "min_correlation"),
    ]:
        with pytest.raises(ValueError, match=f"^{name}:"):
            call()
    with pytest.raises(TypeError, match=r"^grid:"):
        gs.match_map(grid, [[0]])
