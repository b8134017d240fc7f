"""Quadrant empty squares: for each cell and diagonal direction, the side of the largest square of free cells there.

A ray may cross such a square in one step without missing an obstacle. Source: anisotropic Chebyshev distance maps
(Deakin and Knackstedt 2020). Planes are padded by a ring of zeros; plane q grows to (+x, +y), (-x, +y), (+x, -y),
(-x, -y) for q = 0, 1, 2, 3.

The planes may be made anew where only the cells in rows [top, bottom) and columns [left, right) of the map changed:
then only cells whose squares can hold one of these are. Occupied cells are known of a band of rows from row first on.
"""

from __future__ import annotations

import numpy as np

from gpusense.reference.bits import cells_left, cells_right, unpacked

LONGEST = 255
SQUARE_REACH = 254


def reach_begin(way: int, low: int) -> int:
    """First of the cells whose squares, growing that way, can hold the cell low or one beyond it."""
    return max(low - SQUARE_REACH, 0) if way > 0 else low


def reach_end(way: int, high: int, size: int) -> int:
    """One beyond the last of the cells whose squares, growing that way, can hold one before the cell high."""
    return high if way > 0 else min(high + SQUARE_REACH, size)


def square_runs(
    flags: frozenset[str], occupied: np.ndarray, runs: np.ndarray, band: int, cols: int, begin: int, end: int
) -> None:
    """Free cells in a row, to the right (first plane) or left (second plane), at most LONGEST, from begin to end."""
    cells = occupied[: band * cols].reshape(band, cols)[:, begin:end].astype(bool)
    runs[: 2 * band * cols].reshape(2, band, cols)[:, :, begin:end] = _runs(cells)


def _runs(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Free cells to the right and to the left in rows of bool."""
    room = np.arange(1, cells.shape[1] + 1, dtype=np.int32)
    right, left = np.minimum(cells_right(cells), room[::-1]), np.minimum(cells_left(cells), room)
    return np.minimum(right, LONGEST), np.minimum(left, LONGEST)


def square_bits(
    flags: frozenset[str], bits: np.ndarray, runs: np.ndarray, band: int, cols: int, words: int, begin: int, end: int
) -> None:
    """The same from bits, but that whole rows count."""
    out = runs[: 2 * band * cols].reshape(2, band, cols)
    for direction, run in enumerate(_runs(unpacked(bits, band, cols, words))):
        out[direction, :, begin:end] = run[:, begin:end]


def squares_rows(
    flags: frozenset[str],
    runs: np.ndarray,
    squares: np.ndarray,
    rows: int,
    cols: int,
    first: int,
    band: int,
    top: int,
    left: int,
    bottom: int,
    right: int,
) -> None:
    """Rows in the order of growth, each from its neighbour row."""
    planes = squares[: 4 * (rows + 2) * (cols + 2)].reshape(4, rows + 2, cols + 2)
    free = runs[: 2 * band * cols].reshape(2, band, cols)
    for plane in range(4):
        dx, dy = (-1 if plane & 1 else 1), (-1 if plane & 2 else 1)
        begin, end = reach_begin(dx, left), reach_end(dx, right, cols)
        for row in range(reach_begin(dy, top), reach_end(dy, bottom, rows))[::-dy]:
            below = planes[plane, row + 1 + dy]
            side = np.minimum(below[begin + 1 : end + 1], below[begin + 1 + dx : end + 1 + dx])
            side = np.minimum(side, LONGEST - 1) + np.uint8(1)
            planes[plane, row + 1, begin + 1 : end + 1] = np.minimum(free[plane & 1, row - first, begin:end], side)


def squares_scan(
    flags: frozenset[str],
    runs: np.ndarray,
    squares: np.ndarray,
    rows: int,
    cols: int,
    first: int,
    band: int,
    top: int,
    left: int,
    bottom: int,
    right: int,
) -> None:
    """The same number found by looking along the columns."""
    planes = squares[: 4 * (rows + 2) * (cols + 2)].reshape(4, rows + 2, cols + 2)
    free = runs[: 2 * band * cols].reshape(2, band, cols)
    for plane in range(4):
        dx, dy = (-1 if plane & 1 else 1), (-1 if plane & 2 else 1)
        col = slice(reach_begin(dx, left), reach_end(dx, right, cols))
        row = np.arange(reach_begin(dy, top), reach_end(dy, bottom, rows))
        run = free[plane & 1, :, col]
        side = run[row - first].astype(np.int32)
        for i in range(1, LONGEST):
            inside = (row + i * dy >= 0) & (row + i * dy < rows)
            other = run[row[inside] + i * dy - first]
            side[inside] = np.minimum(side[inside], np.maximum(other, i))
            side[~inside] = np.minimum(side[~inside], i)
        planes[plane, row + 1, col.start + 1 : col.stop + 1] = side
