"""Exact squared Euclidean distance transform in cells, in integers.

The device kernels follow Meijster, Roerdink and Hesselink (2000). Here the second pass simply visits every row in turn,
bounded by the farthest obstacle.
"""

from __future__ import annotations

import numpy as np

from gpusense.reference.bits import cells_left, cells_right, unpacked

NO_OBSTACLE = -1
UNREACHABLE = np.iinfo(np.int32).max
# Larger than every squared distance; its sum with another square still fits into 32 bits.
FAR = np.uint32(1 << 31)
BLOCK = 32
# The value of the first pass for cells without an obstacle within reach, and the rows of a block.
FAR_CELLS = 46341
BLOCK_ROWS = 32


def _lines(array: np.ndarray, lines: int, length: int, line_stride: int, step: int) -> np.ndarray:
    """Return a view of a flat array as (lines, length), along rows or columns."""
    size = array.itemsize
    return np.lib.stride_tricks.as_strided(array, (lines, length), (line_stride * size, step * size))


def distance_lines(flags, occupied, along, lines, length, line_stride, step):
    """Count the cells to the nearest occupied cell of the same line, NO_OBSTACLE without one (first pass)."""
    cells = _lines(occupied, lines, length, line_stride, step)
    index = np.arange(length, dtype=np.int32)
    far = np.int32(2 * length + 1)
    before = np.maximum.accumulate(np.where(cells, index, -far), axis=1)
    after = np.minimum.accumulate(np.where(cells, index, 2 * far)[:, ::-1], axis=1)[:, ::-1]
    nearest = np.minimum(index - before, after - index)
    _lines(along, lines, length, line_stride, step)[...] = np.where(nearest < length, nearest, NO_OBSTACLE)


def distance_envelope(flags, along, starts, squared, lines, length, line_stride, step):
    """Find the lowest parabola of a line at each of its cells (second pass)."""
    across = _lines(along, lines, length, line_stride, step)
    out = _lines(squared, lines, length, line_stride, step)
    for block in range(0, lines, BLOCK):
        g = across[block : block + BLOCK]
        out[block : block + BLOCK] = _lowest(np.where(g == NO_OBSTACLE, FAR, (g * g).astype(np.uint32)))


def _lowest(start: np.ndarray) -> np.ndarray:
    """Return the least ``start[:, j] + (i - j)^2`` at each i, UNREACHABLE where all are beyond."""
    best = start.copy()
    for offset in range(1, start.shape[1]):
        square = np.uint32(offset * offset)
        if square >= best.max():
            break
        np.minimum(best[:, offset:], start[:, :-offset] + square, out=best[:, offset:])
        np.minimum(best[:, :-offset], start[:, offset:] + square, out=best[:, :-offset])
    return np.minimum(best, np.uint32(UNREACHABLE)).astype(np.int32)


def distance_bits(flags, bits, nearest, rows, cols, words, reach):
    """Count the cells to the nearest occupied cell of the same row, FAR_CELLS where it is over reach (first pass)."""
    cells = unpacked(bits, rows, cols, words)
    nearest_cells = np.minimum(cells_left(cells), cells_right(cells))
    nearest[: rows * cols] = np.where(nearest_cells > reach, FAR_CELLS, nearest_cells).ravel()


def distance_blocks(flags, nearest, blocks, rows, cols, count):
    """Find the minimum of each column of a block of rows."""
    least = np.minimum.reduceat(nearest[: rows * cols].reshape(rows, cols), np.arange(count) * BLOCK_ROWS, axis=0)
    blocks[: count * cols] = least.ravel()


def squares_sum(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the sum of two squares."""
    return a * a + b * b


def distance_search(flags, nearest, blocks, squared, rows, cols, count, most):
    """Find the least sum of squares along each column, UNREACHABLE where it is over most (second pass)."""
    columns = nearest[: rows * cols].reshape(rows, cols).astype(np.uint32).T
    out = squared[: rows * cols].reshape(rows, cols)
    for begin in range(0, cols, BLOCK):
        column = columns[begin : begin + BLOCK]
        lowest = _lowest(np.where(column == FAR_CELLS, FAR, squares_sum(column, np.zeros_like(column))))
        out[:, begin : begin + BLOCK] = np.where(lowest > most, UNREACHABLE, lowest).T


def fill_field(
    flags, squared, density, table, rows, cols, cap, beyond, from_col, from_row, width, height, begin, stride,
):  # fmt: skip
    """Fill cells of a field's table from squared distances; density has a value for each one up to the cap.

    There are height x width cells, which begin at index begin of the table and at cell (from_row, from_col) of the
    grid; cells outside the grid get beyond.
    """
    size = table.itemsize
    out = np.lib.stride_tricks.as_strided(table[begin:], (height, width), (stride * size, size))
    top, bottom = (min(max(row, 0), rows) for row in (from_row, from_row + height))
    left, right = (min(max(col, 0), cols) for col in (from_col, from_col + width))
    known = squared[: rows * cols].reshape(rows, cols)[top:bottom, left:right]
    out[...] = beyond
    out[top - from_row : bottom - from_row, left - from_col : right - from_col] = density[np.minimum(known, cap)]
