"""The occupancy grid: values, frames, immutability."""

from __future__ import annotations

import copy
import math
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gpusense.world.grid import OccupancyGrid

CELLS = [
    [0, 100, -1],
    [64, 65, 66],
]


def test_every_cell_is_occupied_free_or_unknown():
    grid = OccupancyGrid(CELLS)
    assert grid.occupied.tolist() == [[False, True, False], [False, True, True]]
    assert grid.unknown.tolist() == [[False, False, True], [False, False, False]]
    assert grid.free.tolist() == [[True, False, False], [True, False, False]]


def test_threshold_is_inclusive():
    assert OccupancyGrid(CELLS, occupied_threshold=66).occupied.sum() == 2
    assert OccupancyGrid(CELLS, occupied_threshold=100).occupied.sum() == 1
    assert OccupancyGrid(CELLS, occupied_threshold=1).occupied.sum() == 4


def test_obstacles_count_unknown_as_asked():
    grid = OccupancyGrid(CELLS)
    assert grid.obstacles().tolist() == grid.occupied.tolist()
    assert grid.obstacles(unknown="occupied").tolist() == (grid.occupied | grid.unknown).tolist()


def test_the_grid_owns_read_only_cells():
    source = np.array(CELLS, dtype=np.int8)
    grid = OccupancyGrid(source)
    source[0, 0] = 100
    assert grid.cells[0, 0] == 0
    with pytest.raises(ValueError, match="read-only"):
        grid.cells[0, 0] = 1
    with pytest.raises(ValueError, match="read-only"):
        grid.occupied[0, 0] = True
    assert grid.occupied is grid.occupied
    with pytest.raises(AttributeError):
        grid.resolution = 1.0
    with pytest.raises(AttributeError):
        grid.name = "map"


@pytest.mark.parametrize("dtype", [np.int8, np.uint8, np.int64, ">i2"])
def test_any_integer_dtype_and_order(dtype):
    cells = np.asfortranarray(np.array([[0, 100], [65, 3]], dtype=dtype))
    grid = OccupancyGrid(cells)
    assert grid.cells.tolist() == [[0, 100], [65, 3]]
    assert grid.cells.flags.c_contiguous


def test_equality_and_hash_are_by_value():
    grid = OccupancyGrid(CELLS, 0.1, (1, 2, 3))
    same = OccupancyGrid(np.array(CELLS), 0.1, np.array([1.0, 2.0, 3.0]))
    assert grid == same
    assert hash(grid) == hash(same)
    others = [
        OccupancyGrid([[0, 100, -1], [64, 65, 67]], 0.1, (1, 2, 3)),
        OccupancyGrid(CELLS, 0.2, (1, 2, 3)),
        OccupancyGrid(CELLS, 0.1, (1, 2, 3.5)),
        OccupancyGrid(CELLS, 0.1, (1, 2, 3), occupied_threshold=50),
        OccupancyGrid([[0]], 0.1, (1, 2, 3)),
        "grid",
    ]
    assert all(grid != other for other in others)


@pytest.mark.parametrize("twin", [copy.copy, copy.deepcopy, lambda g: pickle.loads(pickle.dumps(g))])
def test_copies_are_equal_and_read_only(twin):
    grid = OccupancyGrid(CELLS, 0.1, (1, 2, 3), occupied_threshold=50)
    assert twin(grid) == grid
    assert not twin(grid).cells.flags.writeable


def test_cell_zero_touches_the_origin():
    grid = OccupancyGrid(CELLS, 0.5, (10.0, 20.0, 0.0))
    xy = [[10.0, 20.0], [10.5, 20.0], [10.0, 20.5], [11.25, 20.75], [9.75, 19.75]]
    assert grid.world_to_cells(xy).tolist() == [[0, 0], [1, 0], [0, 1], [2.5, 1.5], [-0.5, -0.5]]
    assert grid.cell_centers([0, 1], [0, 2]).tolist() == [[10.25, 20.25], [11.25, 20.75]]
    assert grid.bounds() == (10.0, 20.0, 11.5, 21.0)


def test_a_quarter_turn_is_counter_clockwise():
    grid = OccupancyGrid(CELLS, 1.0, (10.0, 20.0, math.pi / 2))
    # Columns run along the world's y, rows along its -x.
    np.testing.assert_allclose(grid.cell_centers([0, 1], [0, 2]), [[9.5, 20.5], [8.5, 22.5]], atol=1e-12)
    np.testing.assert_allclose(grid.world_to_cells([[8.5, 22.5]]), [[2.5, 1.5]], atol=1e-12)
    np.testing.assert_allclose(grid.bounds(), (8.0, 20.0, 10.0, 23.0), atol=1e-12)


def test_no_turn_means_no_rounding():
    # 5e6 is a multiple of the cell: without a rotation the split is exact.
    grid = OccupancyGrid(CELLS, 0.25, (5e6, -5e6, 0.0))
    assert grid.world_to_cells([[5e6 + 0.375, -5e6 + 0.125]]).tolist() == [[1.5, 0.5]]


@settings(max_examples=50, deadline=None)
@given(
    x=st.floats(-5e6, 5e6),
    y=st.floats(-5e6, 5e6),
    yaw=st.floats(-10, 10),
    resolution=st.floats(1e-3, 100),
    row=st.integers(-50, 50),
    col=st.integers(-50, 50),
)
def test_centres_come_back(x, y, yaw, resolution, row, col):
    grid = OccupancyGrid(CELLS, resolution, (x, y, yaw))
    back = grid.world_to_cells(grid.cell_centers([row], [col]))
    # World coordinates are rounded once to 2**-53 of 5e6 m, and turned with an error of a few such units.
    np.testing.assert_allclose(back, [[col + 0.5, row + 0.5]], atol=1e-8 / resolution + 1e-12)
