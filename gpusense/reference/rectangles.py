"""Empty rectangles: for each cell and sector of directions, width and height of a rectangle of free cells.

The cell is at its corner; sides are at most 255, kept as width + 256 height. A ray may cross such a rectangle in one
step without missing an obstacle; it is the rectangle in which the ray in the middle of the sector stays longest. The
idea follows the anisotropic Chebyshev distance maps of Deakin and Knackstedt (2020), made of squares. Planes are padded
by a ring of zeros, so a walk that leaves the grid stops. Quadrant q extends to (+x, +y), (-x, +y), (+x, -y), (-x, -y)
for q = 0, 1, 2, 3, and has 1, 2 or 4 sectors from flat to steep, with a plane for each. Planes store rows one after the
other, or in groups: a group is stored column by column, so that vertical neighbours are close in memory.

Planes of several worlds of one size are made together: the runs of row i of world w are line i * worlds + w, and
place[w] is the world's first cell in tables with a ring of two cells.

Planes can be updated after a change of the cells in rows [top, bottom) and columns [left, right) of the map: only cells
whose rectangles can contain one of these are computed. For new planes all cells have changed. The input has a band of
whole rows of the map, from row first on.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gpusense.interface.constants import RECTANGLE_REACH
from gpusense.reference.bits import cells_left, cells_right, unpacked

LONGEST = 255
# The entry of an occupied cell; ring cells have 0.
OCCUPIED = 1


def padded(row: np.ndarray, col: np.ndarray, cols: int) -> np.ndarray:
    """Return the index of a cell in a padded plane."""
    return (row + 1) * (cols + 2) + col + 1


def padded_in_groups(row: np.ndarray, col: np.ndarray, cols: int, group: int) -> np.ndarray:
    """Return the index of a cell in a padded plane of groups of rows."""
    return (row + 1) // group * (cols + 2) * group + (col + 1) * group + (row + 1) % group


def reach_begin(way: int, low: int) -> int:
    """Return the first cell whose rectangle, extending that way, can contain the cell low or one beyond it."""
    return max(low - RECTANGLE_REACH, 0) if way > 0 else low


def reach_end(way: int, high: int, size: int) -> int:
    """Return one beyond the last cell whose rectangle, extending that way, can contain a cell before high."""
    return high if way > 0 else min(high + RECTANGLE_REACH, size)


def reached(way: int, part: slice, size: int) -> slice:
    """Return the cells that rectangles of a part can contain, extending that way."""
    if way > 0:
        return slice(part.start, min(part.stop + RECTANGLE_REACH, size))
    return slice(max(part.start - RECTANGLE_REACH, 0), part.stop)


def slope(sectors: int, sector: int) -> tuple[int, int]:
    """Return height and width in the proportion of the ray in the middle of a sector."""
    return {1: [(1, 1)], 2: [(5, 12), (12, 5)], 4: [(1, 5), (2, 3), (3, 2), (5, 1)]}[sectors][sector]


def free_columns(flags, occupied, runs, band, cols, begin, end):
    """Count the free cells along columns of the band, to larger rows (first plane) or smaller rows (second plane)."""
    cells = occupied[: band * cols].reshape(band, cols)[:, begin:end].astype(bool)
    up, down = _runs(np.ascontiguousarray(cells.T))
    out = runs[: 2 * band * cols].reshape(2, band, cols)
    out[0, :, begin:end], out[1, :, begin:end] = up.T, down.T


def _runs(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Count the free cells to the right and to the left in rows of bool."""
    room = np.arange(1, cells.shape[1] + 1, dtype=np.int32)
    right, left = np.minimum(cells_right(cells), room[::-1]), np.minimum(cells_left(cells), room)
    return np.minimum(right, LONGEST), np.minimum(left, LONGEST)


def longest(runs: np.ndarray, along: int, across: int) -> np.ndarray:
    """Find the rectangles of a quadrant and sector that begin at each cell of rows of runs and extend to the right.

    ``runs``: (lines, length) free cells across the lines, at most LONGEST; ``along``: cells along the lines in the
    proportion of the sector's middle.

    Returns:
        (2, lines, length) cells along and across. The longest one that is high enough is combined from powers of two; a
        pyramid holds their least runs. The next longer one, not high enough, may be better.
    """
    lines, length = runs.shape
    levels = [np.pad(runs.astype(np.uint8), ((0, 0), (0, LONGEST + 1)))]
    for power in range(7):
        last = levels[-1]
        shifted = np.zeros_like(last)
        shifted[:, : -(1 << power)] = last[:, 1 << power :]
        levels.append(np.minimum(last, shifted))
    reach = np.zeros((lines, length), np.int32)
    least = np.full((lines, length), LONGEST, np.int32)
    line, place = np.indices((lines, length), np.int32, sparse=True)
    for power in range(7, -1, -1):
        trial = np.minimum(least, levels[power][line, place + reach])
        fits = trial * along >= (reach + (1 << power)) * across
        reach, least = reach + (fits << power), np.where(fits, trial, least)
    lower = np.where(reach < LONGEST, np.minimum(least, levels[0][line, place + reach]), 0)
    longer = lower * along > reach * across
    return np.stack([reach + longer, np.where(longer, lower, np.where(reach > 0, least, 0))])


def _quadrants(
    rows: int, cols: int, top: int, left: int, bottom: int, right: int
) -> Iterator[tuple[int, tuple[int, int], tuple[slice, slice]]]:
    """Yield quadrants, with directions along x and y, and the rows and columns that a change reaches."""
    for quadrant in range(4):
        dx, dy = (-1 if quadrant & 1 else 1), (-1 if quadrant & 2 else 1)
        row = slice(reach_begin(dy, top), reach_end(dy, bottom, rows))
        yield quadrant, (dx, dy), (row, slice(reach_begin(dx, left), reach_end(dx, right, cols)))


def rectangles_rows(
    flags, runs, place, stack, rectangles, rows, cols, sectors, first, band, top, left, bottom, right, worlds, lines,
    group,
):  # fmt: skip
    """Find the widest rectangles of sufficient height along rows, from free cells in columns."""
    if worlds > 1:
        rows_of = runs[: 2 * band * worlds * cols].reshape(2 * band, worlds, cols)
        for w in range(worlds):
            rectangles_rows(
                flags, rows_of[:, w].reshape(-1), place[w:], stack, rectangles, rows, cols, sectors, first, band, top,
                left, bottom, right, 1, lines, group,
            )  # fmt: skip
        return
    free = runs[: 2 * band * cols].reshape(2, band, cols)
    rectangles = rectangles[4 * sectors * int(place[0]) :]
    planes = rectangles[: 4 * sectors * lines * (cols + 2)].reshape(4, sectors, lines * (cols + 2))
    for quadrant, (dx, _), (row, col) in _quadrants(rows, cols, top, left, bottom, right):
        line, column = np.ogrid[row, col]
        cells = padded_in_groups(line, column, cols, group)
        seen = reached(dx, col, cols)
        run = free[quadrant >> 1, row.start - first : row.stop - first, seen][:, ::dx]
        part = slice(col.start - seen.start, col.stop - seen.start)
        for sector in range(sectors):
            height, width = slope(sectors, sector)
            wide, high = longest(run, width, height)[:, :, ::dx]
            planes[quadrant, sector, cells] = np.maximum(wide + 256 * high, OCCUPIED)[:, part]


def free_rows(flags, bits, runs, band, cols, words, begin, end):
    """Count the free cells along rows, to the right (first plane) and to the left (second plane)."""
    out = runs[: 2 * band * cols].reshape(2, band, cols)
    for direction, run in enumerate(_runs(unpacked(bits, band, cols, words))):
        out[direction, :, begin:end] = run[:, begin:end]


def rectangles_scan(
    flags, runs, place, rectangles, rows, cols, sectors, first, band, top, left, bottom, right, worlds, lines,
    group, tall,
):  # fmt: skip
    """Find the highest rectangles of sufficient width along columns, from free cells in rows."""
    if worlds > 1:
        rows_of = runs[: 2 * band * worlds * cols].reshape(2 * band, worlds, cols)
        for w in range(worlds):
            rectangles_scan(
                flags, rows_of[:, w].reshape(-1), place[w:], rectangles, rows, cols, sectors, first, band, top, left,
                bottom, right, 1, lines, group, tall,
            )  # fmt: skip
        return
    free = runs[: 2 * band * cols].reshape(2, band, cols)
    rectangles = rectangles[4 * sectors * int(place[0]) :]
    planes = rectangles[: 4 * sectors * lines * (cols + 2)].reshape(4, sectors, lines * (cols + 2))
    for quadrant, (_, dy), (row, col) in _quadrants(rows, cols, top, left, bottom, right):
        line, column = np.ogrid[row, col]
        cells = padded_in_groups(line, column, cols, group)
        seen = reached(dy, row, rows)
        run = free[quadrant & 1, seen.start - first : seen.stop - first, col][::dy].T
        part = slice(row.start - seen.start, row.stop - seen.start)
        for sector in range(sectors):
            height, width = slope(sectors, sector)
            high, wide = (side.T[::dy] for side in longest(run, height, width))
            planes[quadrant, sector, cells] = np.maximum(wide + 256 * high, OCCUPIED)[part]
