"""Compute normals of a map's walls, for angles of incidence.

The outline of a wall is followed from side to side of its cells. The normal of a straight outline is perpendicular to a
line through the sides of the cell's piece of outline, which ends at corners (``Outlines``).

Elsewhere, on tight bends and in clutter, the occupied cells within RADIUS cells of a cell have a mean and a covariance.
A wall is long and thin, so that its normal is the direction of least variance. A post varies equally in all directions:
its normal is the direction of falling occupancy, the gradient of occupancy smoothed by the same disc.

The host computes normals once per map, in 0.2 s for a building of 1300 x 1730 cells.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gpusense._util import checks
from gpusense._util.typing import Space
from gpusense.backends.base import Buffer
from gpusense.tables.reachable import obstacles_of
from gpusense.tables.world_cells import Stack, Table
from gpusense.tables.worlds import Worlds
from gpusense.world.grid import OccupancyGrid
from gpusense.world.windows import Window, whole

# Outward directions of a cell's sides (column, row). The outline runs along a side in the next direction, with
# obstacles to the left.
_DIRECTIONS = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])


@dataclass(frozen=True)
class Span:
    """Windows of consecutive sides for fitting a line."""

    count: int  # sides of a window
    least: int  # fewest sides before and after the side
    residual: float  # largest mean square distance of the middles to the line [cells^2]
    # For windows at corners, upper limit of the advance of the next CORNER sides along the line at the nearer end
    # [cells]; None for all windows.
    advance: float | None = None


# Earlier spans take precedence, then the least residual. Nearly symmetric windows come first. One-sided windows are
# for corners only: on a bend their direction would be another point's. A straight strip of cells has residuals up to
# 0.09. Discs of a radius of at least 5 cells pass as bends.
SPANS = (Span(17, 8, 0.1), Span(11, 5, 0.1), Span(13, 0, 0.1, 2.0), Span(9, 0, 0.05, 1.2), Span(5, 0, 0.01, 0.8))
CORNER = 5
# Farthest side along the outline that affects a normal.
REACH = max(span.count - 1 - span.least for span in SPANS) + CORNER
# Sides per pass.
_PART = 1 << 15


@dataclass(frozen=True)
class Line:
    """Line fitted to M windows of an outline."""

    normal: np.ndarray  # (M, 2) unit vectors towards the free side
    residual: np.ndarray  # (M,) mean square distance of the middles of sides to the line [cells^2]


class Outlines:
    """Outlines of a map with F sides.

    ``cell``: (F,) flat index of each side's cell; ``outward``: (F, 2) outward direction; ``following``, ``preceding``:
    (F,) next and previous side, the side itself at the map's edge.
    """

    def __init__(self, obstacles: np.ndarray) -> None:
        """Find the sides of (H, W) bool obstacles; cells at the map's edge have no sides."""
        sides, self._width = _exposed_sides(obstacles), obstacles.shape[1]
        direction, row, col = np.nonzero(sides)
        self.cell = row * self._width + col
        self.outward = _DIRECTIONS[direction]
        number = np.full(sides.shape, -1, np.int32)
        number[direction, row, col] = np.arange(len(row))
        self.following = _following(obstacles, number, direction, row, col)
        self.preceding = np.arange(len(row), dtype=np.int32)
        self.preceding[self.following] = np.arange(len(row))
        # Double the coordinates for exact sums.
        self._middle = 2 * np.stack([col, row], axis=1) + self.outward

    def straight_normals(self, sides: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (M, 2) normals of straight pieces of outline around M sides, NaN on a curve, and (M,) their spans."""
        normal, place = np.full((len(sides), 2), np.nan), np.full(len(sides), len(SPANS))
        for first in range(0, len(sides), _PART):
            part = slice(first, first + _PART)
            self._straight(sides[part], normal[part], place[part])
        return normal, place

    def _straight(self, sides: np.ndarray, normal: np.ndarray, place: np.ndarray) -> None:
        """Write the results of :meth:`straight_normals`."""
        behind, ahead = self._moments(sides)
        for index, span in enumerate(SPANS):
            remaining = np.nonzero(place == len(SPANS))[0]
            parts = behind[..., remaining], ahead[..., remaining]
            lowest = np.full(len(remaining), span.residual)
            for back in range(span.least, span.count - span.least):
                front = span.count - 1 - back
                line = _fit_line(parts[0][:, back] + parts[1][:, front], span.count)
                better = line.residual < lowest
                if span.advance is not None:
                    better &= _advance(line, *parts, back, front) < span.advance
                lowest[better] = line.residual[better]
                normal[remaining[better]] = line.normal[better]
                place[remaining[better]] = index

    def _moments(self, sides: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return two arrays (7, REACH + 1, M), for the k preceding and the k following sides of M sides.

        They are sums of x, y, x^2, x y and y^2 of middles relative to the side's [half cells], and of outward
        directions.
        """
        start = self._middle[sides]
        result = []
        for link in (self.preceding, self.following):
            at, sums = sides, np.zeros((7, REACH + 1, len(sides)), np.int32)
            for k in range(1, REACH + 1):
                at = link[at]
                x, y = (self._middle[at] - start).T
                sums[:, k] = sums[:, k - 1] + np.stack([x, y, x * x, x * y, y * y, *self.outward[at].T])
            result.append(sums)
        result[0][5:] += self.outward[sides].T[:, None]
        return result[0], result[1]


def _fit_line(sums: np.ndarray, count: int) -> Line:
    """Fit lines to M windows (``sums``: (7, M) moments from ``Outlines._moments``)."""
    x, y, xx, xy, yy = sums[:5] / np.array([2, 2, 4, 4, 4])[:, None] / count
    xx, xy, yy = xx - x * x, xy - x * y, yy - y * y
    along = 0.5 * np.arctan2(2 * xy, xx - yy)
    normal = np.stack([-np.sin(along), np.cos(along)], axis=1)
    normal *= np.where((normal * sums[5:].T).sum(axis=1) < 0, -1, 1)[:, None]
    return Line(normal, np.maximum((xx + yy) / 2 - np.hypot((xx - yy) / 2, xy), 0))


def _advance(line: Line, behind: np.ndarray, ahead: np.ndarray, back: int, front: int) -> np.ndarray:
    """Return the advance of the CORNER sides beyond the nearer end of M windows along their lines [cells].

    In the middle of a window it is the smaller advance of both ends.
    """
    along = np.stack([-line.normal[:, 1], line.normal[:, 0]])
    result = np.full(len(line.normal), np.inf)
    for sums, end, other, sign in ((ahead, front, back, 1), (behind, back, front, -1)):
        if end <= other:
            last, beyond = (sums[:2, k] - sums[:2, max(k - 1, 0)] for k in (end, end + CORNER))
            result = np.minimum(result, sign * (along * (beyond - last)).sum(axis=0) / 2)
    return result


def _exposed_sides(obstacles: np.ndarray) -> np.ndarray:
    """Return the (4, H, W) mask of cell sides in each direction between an obstacle and free space."""
    sides = np.zeros((4, *obstacles.shape), bool)
    inner = obstacles[1:-1, 1:-1]
    neighbours = (obstacles[1:-1, 2:], obstacles[2:, 1:-1], obstacles[1:-1, :-2], obstacles[:-2, 1:-1])
    for side, neighbour in zip(sides, neighbours, strict=True):
        side[1:-1, 1:-1] = inner & ~neighbour
    return sides


def _following(
    obstacles: np.ndarray, number: np.ndarray, direction: np.ndarray, row: np.ndarray, col: np.ndarray
) -> np.ndarray:
    """Return the number of each side's successor."""
    (ox, oy), (tx, ty) = _DIRECTIONS[direction].T, _DIRECTIONS[(direction + 1) % 4].T
    # Cells are at least one cell from the edge.
    ahead, beside = (row + ty, col + tx), (row + ty + oy, col + tx + ox)
    concave = obstacles[beside]
    straight = ~concave & obstacles[ahead]
    following = np.where(
        concave, number[((direction + 3) % 4, *beside)],
        np.where(straight, number[(direction, *ahead)], number[(direction + 1) % 4, row, col]),
    )  # fmt: skip
    return np.where(following < 0, np.arange(len(row)), following).astype(np.int32)


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
    """Return (rows + 2, cols + 2, 2) normals in a window of a map and a ring around it; see the kernel file ``echo``.

    They are in the grid's frame: 0 for free cells, NaN for occupied cells without a normal.
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
    """Return (H, W, 2) unit normals of exposed cells, in a map with RADIUS cells around it, towards fewer obstacles.

    They are 0 for free cells, and NaN for occupied cells without exposure or direction.
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
    """Replace (H, W, 2) normals of cells at straight pieces of an obstacle's outline, up to its corners.

    A cell takes the side with the longest straight piece. At the corner of a block two sides are equally long, and the
    normal is between theirs.
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
    """Return (6, M) numbers of obstacles in discs around cells, and sums of their x, y, x^2, x y and y^2."""
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
