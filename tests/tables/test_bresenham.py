"""Bresenham's line: by hand, its leaks, and its symmetries."""

from __future__ import annotations

import math

import numpy as np
import pytest

import gpusense as gs
from gpusense.tables import casters


@pytest.mark.parametrize(
    ("shape", "range_max", "line"),
    [
        ((5, 5), 4.5, [(0, 0), (1, 1), (2, 1), (3, 2), (4, 2)]),
        ((5, 9), 8.6, [(0, 0), (1, 0), (2, 1), (3, 1), (4, 2), (5, 2), (6, 2), (7, 3), (8, 3)]),
    ],
)
def test_bresenham_by_hand(shape, range_max, line, backend):
    """Lines from (0, 0) to (4, 2) and (8, 3) end with sqrt(i^2 + j^2) at an obstacle (i, j) on the line."""
    end = line[-1]
    for row, col in np.ndindex(shape):
        cells = np.zeros(shape, int)
        cells[row, col] = 100
        caster = gs.RayCaster(gs.OccupancyGrid(cells, 1.0), range_max, method="bresenham", backend=backend)
        expected = math.sqrt(col * col + row * row) if (col, row) in line else range_max
        assert caster.cast([[0.5, 0.5, math.atan2(end[1], end[0])]], [0.0])[0, 0] == np.float32(expected)


@pytest.mark.long
def test_bresenham_slips_between_walls_that_touch_at_a_corner(backend):
    cells = np.zeros((6, 6), int)
    cells[1, 2] = cells[2, 1] = cells[4, 4] = 100
    grid, pose = gs.OccupancyGrid(cells, 1.0), [[1.5, 1.5, math.pi / 4]]
    found = {
        name: gs.RayCaster(grid, 5.0, method=name, backend=backend).cast(pose, [0.0])[0, 0] for name in casters.CASTERS
    }
    assert found["bresenham"] == np.float32(math.sqrt(18))
    assert found["exact"] == found["dda"] == np.float32(math.sqrt(0.5))


def test_bresenham_is_the_same_in_eight_directions(backend):
    rng = np.random.default_rng(3)
    cells, angles = np.where(rng.random((21, 21)) < 0.05, 100, 0), rng.uniform(-np.pi, np.pi, 200)
    cells[10, 10] = 0
    x, y = np.cos(angles), np.sin(angles)
    turned = [(cells, x, y), (cells.T, y, x)]
    for some, u, v in list(turned):
        turned += [(some[:, ::-1], -u, v), (some[::-1], u, -v), (some[::-1, ::-1], -u, -v)]
    results = []
    for some, u, v in turned:
        caster = gs.RayCaster(
            gs.OccupancyGrid(some, 1.0), 9.7, method="bresenham", backend=backend, precision="float64"
        )
        results.append(caster.cast([[10.5, 10.5, 0.0]], np.arctan2(v, u))[0])
    assert 20 < np.count_nonzero(results[0] < 9.7) < 200
    assert (np.array(results) == results[0]).all()
