"""Directional tables by brute force, and the obstacles that their ranges may miss."""

from __future__ import annotations

import functools
import math

import numpy as np
import pytest
from scipy.spatial import cKDTree
from support.caster_world import lists_of

import gpusense as gs
from gpusense.evaluation.worlds import building, cloud_uniform
from gpusense.tables.casters import Cddt
from gpusense.tables.directional import directional_table


def clipped_begin(col: int, row: int, turn: float, line: int) -> float | None:
    """Return where a cell begins on a line of its bin's direction, in plain Python; None if it is not on the line.

    The cell begins at the point of its outline that is farthest back on the middle of the line, or, if it does not
    reach the middle, at its corner nearest to it.
    """
    cos, sin = math.cos(turn), math.sin(turn)
    corners = [(col, row), (col + 1, row), (col + 1, row + 1), (col, row + 1)]
    points = [(x * cos + y * sin, y * cos - x * sin) for x, y in corners]
    low, high = min(v for _, v in points), max(v for _, v in points)
    if high <= line + 1e-9 or low >= line + 1 - 1e-9:
        return None
    middle = min(max(line + 0.5, low), high)
    found = []
    for (u0, v0), (u1, v1) in zip(points, points[1:] + points[:1], strict=True):
        if min(v0, v1) - 1e-12 <= middle <= max(v0, v1) + 1e-12:
            found += [u0, u1] if abs(v1 - v0) < 1e-9 else [u0 + (u1 - u0) * (middle - v0) / (v1 - v0)]
    return min(found)


@pytest.mark.parametrize("bins", [4, 7, 8, 12])
def test_directional_table_by_brute_force(bins):
    rng = np.random.default_rng(bins)
    obstacles = rng.random((7, 9)) < 0.3
    obstacles[2:5, 3:6] = True  # The cell (4, 3) faces no free cell.
    expected: dict[tuple[int, int], list[float]] = {}
    for row, col in np.argwhere(obstacles).tolist():
        if obstacles[max(row - 1, 0) : row + 2, max(col - 1, 0) : col + 2].all() and 0 < row < 6 and 0 < col < 8:
            continue
        for bin in range(bins):
            for line in range(-20, 20):
                begin = clipped_begin(col, row, 2 * math.pi * bin / bins, line)
                if begin is not None:
                    expected.setdefault((bin, line), []).append(begin)
    found = lists_of(directional_table(obstacles, bins, pruned=False, outside=False), bins)
    assert found.keys() == expected.keys()
    for key, begins in expected.items():
        assert np.abs(np.array(found[key]) - 1024 * np.sort(begins)).max() <= 0.5 + 1e-6, key
    pruned = lists_of(directional_table(obstacles, bins, pruned=True, outside=False), bins)
    for key, begins in found.items():
        # The first is seen from afar, and nothing is added.
        assert pruned[key][0] == begins[0] and not set(pruned[key]) - set(begins)
    assert sum(map(len, pruned.values())) < sum(map(len, found.values()))


@functools.cache
def floor() -> tuple[gs.OccupancyGrid, np.ndarray, np.ndarray]:
    """Return a floor of a building, poses in its free cells, and their distances to the nearest obstacle's centre."""
    grid = building(3, (12.0, 10.0), 0.1)
    poses = cloud_uniform(grid, 1500, np.random.default_rng(4))
    row, col = np.nonzero(grid.occupied)
    return grid, poses, cKDTree(grid.cell_centers(row, col)).query(poses[:, :2])[0] / grid.resolution


@pytest.mark.parametrize("bins", [36, 216])
def test_directional_ranges_end_near_an_obstacle_and_pass_none(bins):
    """Bounds are range * pi / bins + 1 cell across the ray, and a cell's diagonal along it, in both directions."""
    grid, poses, _ = floor()
    limit, bearings = 6.0 / grid.resolution, np.linspace(0, 6, 5)
    cast = functools.partial(gs.RayCaster, grid, 6.0, backend="auto", precision="float64")
    found = cast(method=Cddt(bins, pruned=False)).cast(poses, bearings) / grid.resolution
    angle = poses[:, 2, None] + bearings
    x, y = (poses[:, i, None] / grid.resolution + found * f(angle) for i, f in ((0, np.cos), (1, np.sin)))
    row, col = np.nonzero(grid.occupied)
    near = cKDTree(np.column_stack([col + 0.5, row + 0.5])).query(np.stack([x, y], axis=-1), 30)[1]
    off = [np.maximum(np.abs(place[..., None] - at[near] - 0.5) - 0.5, 0) for place, at in ((x, col), (y, row))]
    distance = np.hypot(*off).min(axis=-1)
    assert (distance <= 1.01 + found * (math.pi / bins + 2e-5))[found < limit].all()
    # The exact ray in the bin's direction enters a cell of the origin's line; it may begin a diagonal off.
    turned = np.round(angle * bins / (2 * math.pi)) * (2 * math.pi / bins)
    clear = np.abs(angle - turned) < 0.49 * 2 * math.pi / bins
    aligned = np.column_stack([np.repeat(poses[:, :2], 5, axis=0), turned.ravel()])
    exact = cast().cast(aligned, [0.0]).reshape(found.shape) / grid.resolution
    assert (found <= np.minimum(exact + 1.42, limit))[clear & (exact > 1.42)].all()


def test_pruned_ranges_differ_beside_an_obstacle_only(backend):
    """Only obstacles that begin inside another obstacle of their line are omitted, so ranges differ only there."""
    grid, poses, clearance = floor()
    for bins in (36, 216):
        every, pruned = (gs.RayCaster(grid, 6.0, method=Cddt(bins, p), backend=backend) for p in (False, True))
        longer = pruned.cast(poses, np.linspace(0, 6, 5)) - every.cast(poses, np.linspace(0, 6, 5))
        assert (longer >= 0).all() and np.count_nonzero(longer) <= 0.01 * longer.size
        assert (longer[clearance > 1.86] == 0).all()
        assert pruned.table_bytes < every.table_bytes
