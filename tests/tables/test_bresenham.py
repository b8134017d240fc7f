"""Bresenham's line: by hand, its leaks, and its symmetries."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.ndimage import distance_transform_cdt

import gpusense as gs
from gpusense.tables import casters
from gpusense.tables.distances import chebyshev_distances


def line_to(end: tuple[int, int], last: int, straight: bool) -> list[tuple[int, int]]:
    """Return the cells of a line from (0, 0), stepping from cell to cell."""
    far = max(abs(end[0]), abs(end[1]))
    flat, error, aside, cells = abs(end[0]) >= abs(end[1]), 0, 0, []
    for along in range(last + 1):
        i, j = (along, aside) if flat else (aside, along)
        cells.append((i if end[0] > 0 else -i, j if end[1] > 0 else -j))
        error += min(abs(end[0]), abs(end[1]))
        if 2 * error > far or (2 * error == far and not straight):
            aside, error = aside + 1, error - far
    return cells


@pytest.mark.long_on("warp")
@pytest.mark.parametrize("range_max", [0.6, 1.3, 14.8, 200.0])
@pytest.mark.parametrize("lines", [None, "amcl", "beluga"])
def test_leaps_land_on_the_cells_of_single_steps(lines, range_max, backend):
    """Lines in 300 directions, also to the map's edge, meet the obstacle that steps from cell to cell meet."""
    rng = np.random.default_rng(1)
    cells = np.where(rng.random((31, 37)) < 0.02, 100, 0)
    cells[14, 18] = 0
    x, y = rng.integers(-17, 18, (2, 300))
    angles = np.arctan2(y, x)
    for outside in ("free", "occupied"):
        caster = gs.RayCaster(
            gs.OccupancyGrid(cells, 1.0), range_max, method=casters.Bresenham(lines), backend=backend,
            precision="float64", outside=outside,
        )  # fmt: skip
        ranges = caster.cast([[18.5, 14.5, 0.0]], angles)[0]
        for angle, found in zip(angles, ranges, strict=True):
            place = 0.5 + range_max * np.array([math.cos(angle), math.sin(angle)])
            if np.abs(place - np.rint(place)).min() < 1e-9:
                continue
            end = tuple(np.floor(place).astype(int))
            last = max(abs(end[0]), abs(end[1])) + (lines == "amcl")
            expected = range_max
            for i, j in line_to(end, last, lines == "beluga"):
                inside = 0 <= 14 + j < 31 and 0 <= 18 + i < 37
                if cells[14 + j, 18 + i] if inside else outside == "occupied":
                    expected = math.hypot(i, j)
                if expected != range_max or not inside:
                    break
            assert found == (expected if lines == "amcl" else min(expected, range_max)), (angle, end)


def test_chebyshev_distances_are_scipys():
    rng = np.random.default_rng(2)
    for shape, share in (((1, 1), 1.0), ((1, 9), 0.2), ((40, 1), 0.1), ((60, 35), 0.003), ((700, 530), 0.00001)):
        blocked = rng.random(shape) < share
        blocked[0, 0] = True
        expected = np.minimum(distance_transform_cdt(~blocked, "chessboard"), 254)
        np.testing.assert_array_equal(chebyshev_distances(blocked, 254), expected)
