"""Quadrant empty squares: for each cell and each of the four diagonal directions, the side of the largest square of
free cells that has the cell at its corner and grows that way, at most 255. A ray may cross such a square in one
step without missing an obstacle. Source: anisotropic Chebyshev distance maps (Deakin and Knackstedt 2020).

Planes are padded by a ring of zeros, so a walk that leaves the grid stops there. Plane q grows to
(+x, +y), (-x, +y), (+x, -y), (-x, -y) for q = 0, 1, 2, 3. The four planes have fewer than 2^31 cells, so indices fit
int32.
"""

from types import SimpleNamespace

import warp as wp

from .prelude import kernel

LONGEST = wp.constant(255)


@wp.func
def padded(row: wp.int32, col: wp.int32, cols: wp.int32):
    return (row + 1) * (cols + 2) + col + 1


# One work-item a row and direction: free cells in a row, to the right (direction 0) or left (direction 1).
@kernel
def square_runs(occupied: wp.array(dtype=wp.uint8), runs: wp.array(dtype=wp.uint8), rows: wp.int32, cols: wp.int32):
    leftward, row = wp.tid()
    if row >= rows:
        return
    out = leftward * rows * cols + row * cols
    run = int(0)
    for i in range(cols):
        col = wp.where(leftward == 1, i, cols - 1 - i)
        run = wp.where(occupied[row * cols + col] != wp.uint8(0), 0, wp.min(run + 1, LONGEST))
        runs[out + col] = wp.uint8(run)


# For serial devices, one work-item a plane: rows in the order of growth, each from its neighbour row.
@kernel
def squares_rows(runs: wp.array(dtype=wp.uint8), squares: wp.array(dtype=wp.uint8), rows: wp.int32, cols: wp.int32):
    plane = wp.tid()
    dx = wp.where((plane & 1) != 0, -1, 1)
    dy = wp.where((plane & 2) != 0, -1, 1)
    run = (plane & 1) * rows * cols
    out = plane * (rows + 2) * (cols + 2)
    for i in range(rows):
        row = wp.where(dy > 0, rows - 1 - i, i)
        row_run = run + row * cols
        neighbour = out + padded(row + dy, 0, cols)
        here = out + padded(row, 0, cols)
        for col in range(cols):
            side = 1 + wp.min(int(squares[neighbour + col]), int(squares[neighbour + col + dx]))
            squares[here + col] = wp.uint8(wp.min(int(runs[row_run + col]), side))


# For parallel devices, one work-item a cell and plane: the same number found by looking along the column.
@kernel
def squares_scan(runs: wp.array(dtype=wp.uint8), squares: wp.array(dtype=wp.uint8), rows: wp.int32, cols: wp.int32):
    plane, cell = wp.tid()
    if cell >= rows * cols:
        return
    dy = wp.where((plane & 2) != 0, -1, 1)
    row = cell // cols
    col = cell % cols
    run = (plane & 1) * rows * cols + col
    side = int(runs[run + row * cols])
    i = int(1)
    while i < side:
        other = row + i * dy
        if other < 0 or other >= rows:
            side = i
        else:
            side = wp.min(side, wp.max(int(runs[run + other * cols]), i))
        i += 1
    squares[plane * (rows + 2) * (cols + 2) + padded(row, col, cols)] = wp.uint8(side)


_KERNELS = {"square_runs": square_runs, "squares_rows": squares_rows, "squares_scan": squares_scan}


def functions(flags):
    """padded; no flag changes it."""
    return SimpleNamespace(padded=padded)


def make(name, flags):
    """A kernel of this file; no flag changes it."""
    return _KERNELS[name]
