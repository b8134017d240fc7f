"""Compute normals of a map's walls, for angles of incidence.

The outline of a wall is followed from side to side of its cells. The normal of a straight outline is perpendicular to a
line through the sides of the cell's piece of outline, which ends at corners (``outlines``).

Elsewhere, on tight bends and in clutter, the occupied cells within RADIUS cells of a cell have a mean and a covariance.
A wall is long and thin, so that its normal is the direction of least variance. A post varies equally in all directions:
its normal is the direction of falling occupancy, the gradient of occupancy smoothed by the same disc.

The host computes normals once per map, in 0.2 s for a building of 1300 x 1730 cells.
"""

from __future__ import annotations

import math

import numpy as np

from gpusense._util import checks
from gpusense._util.typing import Space
from gpusense.backends.base import Buffer
from gpusense.tables.outlines import REACH, SPANS, Outlines
from gpusense.tables.reachable import obstacles_of
from gpusense.tables.world_stack import Stack, Table
from gpusense.tables.worlds import Worlds
from gpusense.world.grid import OccupancyGrid
from gpusense.world.windows import Window, whole

# Radius of the disc of cells [cells]; a square would favour its diagonals. On slanted walls the mean error of a disc's
# normal is 1.5 degrees, or 2.5 with a radius of 3.
RADIUS = 4
# Largest ratio of the smaller to the larger variance for a principal direction.
_ROUND = 0.5
# Fewest occupied cells of a surface in the disc, including the cell itself.
_FEWEST = 3
# Cells per strip.
_STRIP = 1 << 21
# Farthest cell that a normal depends on.
_MARGIN = REACH + 2
# Straight sides of a cell with a smaller cosine between their normals are the two sides of a thin wall.
_OPPOSITE = -0.5


def surface_normals(grid: OccupancyGrid, *, unknown: Space = "free", outside: Space = "free") -> np.ndarray:
    """Compute the normals of a map's walls.

    The hit face of a cell does not follow a slanted wall. A cell's normal is therefore perpendicular to a line through
    up to 17 sides of the surrounding wall cells. The line ends at corners: within 4 cells of a corner the mean error of
    normals is 2 degrees. Elsewhere on straight walls it is 0.8 degrees at any angle, and at most 5. A cell in a corner
    has the normal of one wall, or a normal between both. On a curved outline the normal is the direction of least
    variance (principal components) of the occupied cells within 4 cells or, as at posts without such a direction, the
    direction of falling occupancy. A cell has no normal if it has fewer than two other occupied cells nearby, neither
    direction, or no side next to a free cell.

    Args:
        grid: The map.
        unknown: Treatment of unknown cells: ``"free"`` or ``"occupied"``.
        outside: Treatment of space outside the grid: ``"free"`` or ``"occupied"``.

    Returns:
        (H, W, 2) float64 unit vectors in the world's frame, towards the free side; NaN for a cell without a normal.

    Raises:
        TypeError, ValueError: An argument has the wrong type, or breaks a rule above.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> cells = np.zeros((9, 9), int)
        >>> cells[4] = 100
        >>> np.abs(gs.surface_normals(gs.OccupancyGrid(cells))[4, 4]).round(3).tolist()
        [0.0, 1.0]
    """
    checks.instance("grid", grid, OccupancyGrid)
    checks.choice("unknown", unknown, ("free", "occupied"))
    checks.choice("outside", outside, ("free", "occupied"))
    obstacles = obstacles_of(grid, unknown)
    table = normal_table(obstacles, whole(grid), outside, np.dtype(np.float64))[1:-1, 1:-1]
    table[~obstacles] = np.nan
    c, s = math.cos(grid.origin[2]), math.sin(grid.origin[2])
    return table @ np.array([[c, s], [-s, c]])


def normal_table(obstacles: np.ndarray, window: Window, outside: str, real: np.dtype) -> np.ndarray:
    """Compute normals in a window of a map and a ring around it, in the layout of the kernel file ``echo``.

    ``obstacles``: (H, W) bool, the whole map; ``outside``: treatment of space outside the map: ``"free"`` or
    ``"occupied"``.

    Returns:
        (rows + 2, cols + 2, 2) in the grid's frame: 0 for free cells, NaN for occupied cells without a normal.
    """
    table = np.empty((window.rows + 2, window.cols + 2, 2), real)
    step = max(_STRIP // table.shape[1], 1)
    for first in range(0, len(table), step):
        rows = min(step, len(table) - first)
        row, col = window.row - 1 + first - _MARGIN, window.col - 1 - _MARGIN
        part = Window(row, col, rows + 2 * _MARGIN, window.cols + 2 + 2 * _MARGIN)
        surrounded = _surrounded(obstacles, part, outside == "occupied")
        rest = _MARGIN - RADIUS
        normals = _disc_normals(surrounded[rest:-rest, rest:-rest])
        _replace_straight(normals, surrounded)
        table[first : first + rows] = normals
    return table


def normals_of_worlds(worlds: Worlds, unknown: str, outside: str, real: np.dtype) -> Table:
    """Return the normals of all worlds on their device; models share them. The host computes them world by world."""

    def fill(stack: Stack, table: Buffer) -> None:
        for index in stack.indices.tolist():
            obstacles = obstacles_of(worlds.grid(index), unknown)
            worlds.put(index, table, normal_table(obstacles, Window(0, 0, *obstacles.shape), outside, real), 2)

    def make() -> Table:
        return Table(worlds.allocate(2, real), 2 * real.itemsize * worlds.cells, fill)

    return worlds.table(("normals", unknown, outside, real), make)


def _surrounded(obstacles: np.ndarray, part: Window, outside: bool) -> np.ndarray:
    """Return a part of a map; every cell beyond the map is ``outside``."""
    result = np.full((part.rows, part.cols), outside)
    inside = part.shared(Window(0, 0, *obstacles.shape))
    if inside is not None:
        inside.moved(-part.row, -part.col).cut(result)[...] = inside.cut(obstacles)
    return result


def _disc_normals(obstacles: np.ndarray) -> np.ndarray:
    """Compute unit normals of exposed cells: occupied cells that share a side with a free cell.

    ``obstacles``: (H + 2 RADIUS, W + 2 RADIUS) bool: a map and its surroundings.

    Returns:
        (H, W, 2) float64, x and y in the grid's frame, towards the side with fewer obstacles: 0 for free cells, NaN
        for occupied cells without exposure or direction.
    """
    height, width = (side - 2 * RADIUS for side in obstacles.shape)
    inner = obstacles[RADIUS : RADIUS + height, RADIUS : RADIUS + width]
    normals = np.zeros((height, width, 2))
    normals[inner] = np.nan
    near = obstacles[RADIUS - 1 : RADIUS + height + 1, RADIUS - 1 : RADIUS + width + 1]
    buried = near[:-2, 1:-1] & near[2:, 1:-1] & near[1:-1, :-2] & near[1:-1, 2:]
    row, col = np.nonzero(inner & ~buried)
    count, x, y, xx, xy, yy = _moments(obstacles, row, col)
    mean_x, mean_y = x / count, y / count
    xx, xy, yy = xx / count - mean_x * mean_x, xy / count - mean_x * mean_y, yy / count - mean_y * mean_y
    # The variances along the principal axes are middle +- apart.
    middle, apart = (xx + yy) / 2, np.hypot((xx - yy) / 2, xy)
    flat = (middle - apart <= _ROUND * (middle + apart)) & (count >= _FEWEST)
    along = 0.5 * np.arctan2(2 * xy, xx - yy)
    across = np.stack([-np.sin(along), np.cos(along)], axis=1)
    downhill = np.stack([-mean_x, -mean_y], axis=1)
    across *= np.where((across * downhill).sum(axis=1) < 0, -1, 1)[:, None]
    steepness = np.hypot(mean_x, mean_y)
    has_gradient = (steepness > 0) & (count >= _FEWEST)
    downhill /= np.where(has_gradient, steepness, 1)[:, None]
    normals[row, col] = np.where(flat[:, None], across, np.where(has_gradient[:, None], downhill, np.nan))
    return normals


def _replace_straight(normals: np.ndarray, obstacles: np.ndarray) -> None:
    """Replace the normals of cells at straight pieces of an obstacle's outline, up to its corners.

    A cell takes the side with the longest straight piece. At the corner of a block two sides are equally long, and the
    normal is between theirs.

    ``normals``: (H, W, 2) normals; ``obstacles``: (H + 2 MARGIN, W + 2 MARGIN) bool: the map and its surroundings.
    """
    outlines = Outlines(obstacles)
    height, width = normals.shape[:2]
    row, col = (index - _MARGIN for index in np.divmod(outlines.cell, obstacles.shape[1]))
    sides = np.nonzero((row >= 0) & (row < height) & (col >= 0) & (col < width))[0]
    cell = row[sides] * width + col[sides]
    normal, place = outlines.straight_normals(sides)
    best = np.full(height * width, len(SPANS))
    np.minimum.at(best, cell, place)
    counts = (place == best[cell]) & (place < len(SPANS))
    cell, normal = cell[counts], normal[counts]
    # Write the first of a cell's sides last.
    first, total = np.zeros((2, height * width, 2))
    first[cell[::-1]] = normal[::-1]
    opposite = (first[cell] * normal).sum(axis=1) < _OPPOSITE
    np.add.at(total, cell, np.where(opposite, -1, 1)[:, None] * normal)
    length = np.hypot(*total.T)
    known = length > 0
    normals.reshape(-1, 2)[known] = total[known] / length[known, None]


def _moments(obstacles: np.ndarray, row: np.ndarray, col: np.ndarray) -> np.ndarray:
    """Sum the moments of the obstacles in the disc around cells.

    Returns:
        (6, M) number of obstacles, and sums of x, y, x^2, x y and y^2 of their offsets.
    """
    bits = np.arange(2 * RADIUS + 1)
    width = obstacles.shape[1] - 2 * RADIUS
    # Bit i of a word is cell i of a row of the disc's box.
    words = np.zeros((len(obstacles), width), np.uint16)
    for bit in bits:
        words |= obstacles[:, bit : bit + width].astype(np.uint16) << np.uint16(bit)
    is_set = (np.arange(1 << len(bits))[:, None] >> bits) & 1
    sums = np.zeros((6, len(row)), np.int64)
    for y in range(-RADIUS, RADIUS + 1):
        within = (bits - RADIUS) ** 2 + y * y <= (RADIUS + 0.5) ** 2
        by_word = (is_set * within) @ np.stack([np.ones_like(bits), bits - RADIUS, (bits - RADIUS) ** 2], axis=1)
        n, x, xx = by_word[words[row + RADIUS + y, col]].T
        sums += np.stack([n, x, y * n, xx, y * x, y * y * n])
    return sums.astype(np.float64)
