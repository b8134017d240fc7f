"""Quadrant empty squares: for each cell and diagonal direction, the side of the largest square of free cells there.

A ray may cross such a square in one step without missing an obstacle. Source: anisotropic Chebyshev distance maps
(Deakin and Knackstedt 2020). Planes are padded by a ring of zeros; plane q grows to (+x, +y), (-x, +y), (+x, -y),
(-x, -y) for q = 0, 1, 2, 3.
"""

from __future__ import annotations

import numpy as np

LONGEST = 255


def square_runs(flags: frozenset[str], occupied: np.ndarray, runs: np.ndarray, rows: int, cols: int) -> None:
    """Free cells in a row, to the right (first plane) or left (second plane), at most LONGEST."""
    cells = occupied[: rows * cols].reshape(rows, cols).astype(bool)
    out = runs[: 2 * rows * cols].reshape(2, rows, cols)
    index = np.arange(cols, dtype=np.int32)
    right = np.minimum.accumulate(np.where(cells, index, cols)[:, ::-1], axis=1)[:, ::-1] - index
    left = index - np.maximum.accumulate(np.where(cells, index, -1), axis=1)
    out[0] = np.minimum(right, LONGEST)
    out[1] = np.minimum(left, LONGEST)


def squares_rows(flags: frozenset[str], runs: np.ndarray, squares: np.ndarray, rows: int, cols: int) -> None:
    """Rows in the order of growth, each from its neighbour row."""
    planes = squares[: 4 * (rows + 2) * (cols + 2)].reshape(4, rows + 2, cols + 2)
    free = runs[: 2 * rows * cols].reshape(2, rows, cols)
    for plane in range(4):
        dx, dy = (-1 if plane & 1 else 1), (-1 if plane & 2 else 1)
        for row in range(rows)[::-dy]:
            below = planes[plane, row + 1 + dy]
            side = np.minimum(below[1:-1], below[1 + dx : cols + 1 + dx])
            side = np.minimum(side, LONGEST - 1) + np.uint8(1)
            planes[plane, row + 1, 1:-1] = np.minimum(free[plane & 1, row], side)


def squares_scan(flags: frozenset[str], runs: np.ndarray, squares: np.ndarray, rows: int, cols: int) -> None:
    """The same number found by looking along the columns."""
    planes = squares[: 4 * (rows + 2) * (cols + 2)].reshape(4, rows + 2, cols + 2)
    free = runs[: 2 * rows * cols].reshape(2, rows, cols)
    for plane in range(4):
        run = free[plane & 1] if plane & 2 == 0 else free[plane & 1, ::-1]
        side = run.astype(np.int32)
        for i in range(1, min(rows, LONGEST)):
            side[:-i] = np.minimum(side[:-i], np.maximum(run[i:], i))
        room = rows - np.arange(rows, dtype=np.int32)[:, None]
        side = np.minimum(side, room)
        planes[plane, 1:-1, 1:-1] = side if plane & 2 == 0 else side[::-1]
