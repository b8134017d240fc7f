"""Quadrant empty squares: for each cell and each of the four diagonal directions, the side of the largest square of
free cells that has the cell at its corner and grows that way, at most 255. A ray may cross such a square in one
step without missing an obstacle. Source: anisotropic Chebyshev distance maps (Deakin and Knackstedt 2020).

Planes are padded by a ring of zeros, so a walk that leaves the grid stops there. Plane q grows to
(+x, +y), (-x, +y), (+x, -y), (-x, -y) for q = 0, 1, 2, 3. The four planes have fewer than 2^31 cells, so indices fit
int32.

The four planes may be made anew where only the cells in rows [top, bottom) and columns [left, right) of the map
changed: then only cells whose squares can hold one of these are. Made at first, all of them have changed. What is
known of occupied cells is a band of whole rows of the map from row first on.
"""

from types import SimpleNamespace

import warp as wp

from .bits import cells_left, cells_right
from .prelude import kernel

LONGEST = wp.constant(255)
# Cells from a changed cell to the farthest one whose square holds it.
SQUARE_REACH = wp.constant(254)


@wp.func
def padded(row: wp.int32, col: wp.int32, cols: wp.int32):
    return (row + 1) * (cols + 2) + col + 1


# Along an axis: the cells whose squares, growing to larger (way 1) or smaller (way -1) indices, can hold one of those
# in [low, high) are those from reach_begin to before reach_end.
@wp.func
def reach_begin(way: wp.int32, low: wp.int32):
    return wp.where(way > 0, wp.max(low - SQUARE_REACH, 0), low)


@wp.func
def reach_end(way: wp.int32, high: wp.int32, size: wp.int32):
    return wp.where(way > 0, high, wp.min(high + SQUARE_REACH, size))


# For serial devices, one work-item a row of the band and direction: free cells in the row, to the right (direction 0)
# or left (direction 1), as far as from begin to end.
@kernel
def square_runs(
    occupied: wp.array(dtype=wp.uint8),
    runs: wp.array(dtype=wp.uint8),
    band: wp.int32,
    cols: wp.int32,
    begin: wp.int32,
    end: wp.int32,
):
    leftward, row = wp.tid()
    if row >= band:
        return
    out = leftward * band * cols + row * cols
    run = int(0)
    for i in range(end - begin):
        col = wp.where(leftward == 1, begin + i, end - 1 - i)
        run = wp.where(occupied[row * cols + col] != wp.uint8(0), 0, wp.min(run + 1, LONGEST))
        runs[out + col] = wp.uint8(run)


# For parallel devices, one work-item a cell from begin to before end: the same for both directions, but that whole
# rows count.
@kernel
def square_bits(
    bits: wp.array(dtype=wp.int32),
    runs: wp.array(dtype=wp.uint8),
    band: wp.int32,
    cols: wp.int32,
    words: wp.int32,
    begin: wp.int32,
    end: wp.int32,
):
    row, item = wp.tid()
    col = begin + item
    if row >= band or col >= end:
        return
    cell = row * cols + col
    right = wp.min(cells_right(bits, row * words, words, col, LONGEST), cols - col)
    left = wp.min(cells_left(bits, row * words, col, LONGEST), col + 1)
    runs[cell] = wp.uint8(wp.min(right, LONGEST))
    runs[band * cols + cell] = wp.uint8(wp.min(left, LONGEST))


# For serial devices, one work-item a plane: rows in the order of growth, each from its neighbour row.
@kernel
def squares_rows(
    runs: wp.array(dtype=wp.uint8),
    squares: wp.array(dtype=wp.uint8),
    rows: wp.int32,
    cols: wp.int32,
    first: wp.int32,
    band: wp.int32,
    top: wp.int32,
    left: wp.int32,
    bottom: wp.int32,
    right: wp.int32,
):
    plane = wp.tid()
    dx = wp.where((plane & 1) != 0, -1, 1)
    dy = wp.where((plane & 2) != 0, -1, 1)
    run = (plane & 1) * band * cols
    out = plane * (rows + 2) * (cols + 2)
    begin_col = reach_begin(dx, left)
    end_col = reach_end(dx, right, cols)
    begin_row = reach_begin(dy, top)
    end_row = reach_end(dy, bottom, rows)
    for i in range(end_row - begin_row):
        row = wp.where(dy > 0, end_row - 1 - i, begin_row + i)
        row_run = run + (row - first) * cols
        neighbour = out + padded(row + dy, 0, cols)
        here = out + padded(row, 0, cols)
        for col in range(begin_col, end_col):
            side = 1 + wp.min(int(squares[neighbour + col]), int(squares[neighbour + col + dx]))
            squares[here + col] = wp.uint8(wp.min(int(runs[row_run + col]), side))


# For parallel devices, one work-item a cell and plane: the same number found by looking along the column. The first
# work-item of a plane has the first of its cells.
@kernel
def squares_scan(
    runs: wp.array(dtype=wp.uint8),
    squares: wp.array(dtype=wp.uint8),
    rows: wp.int32,
    cols: wp.int32,
    first: wp.int32,
    band: wp.int32,
    top: wp.int32,
    left: wp.int32,
    bottom: wp.int32,
    right: wp.int32,
):
    plane, row_item, col_item = wp.tid()
    dx = wp.where((plane & 1) != 0, -1, 1)
    dy = wp.where((plane & 2) != 0, -1, 1)
    col = reach_begin(dx, left) + col_item
    row = reach_begin(dy, top) + row_item
    if col >= reach_end(dx, right, cols) or row >= reach_end(dy, bottom, rows):
        return
    run = (plane & 1) * band * cols + (row - first) * cols + col
    next_row = dy * cols
    side = wp.min(int(runs[run]), wp.where(dy > 0, rows - row, row + 1))
    i = int(1)
    # Four rows between two decisions, so that reads need not wait for one another.
    while i + 3 < side:
        a = wp.max(int(runs[run + i * next_row]), i)
        b = wp.max(int(runs[run + (i + 1) * next_row]), i + 1)
        c = wp.max(int(runs[run + (i + 2) * next_row]), i + 2)
        d = wp.max(int(runs[run + (i + 3) * next_row]), i + 3)
        side = wp.min(side, wp.min(wp.min(a, b), wp.min(c, d)))
        i += 4
    while i < side:
        side = wp.min(side, wp.max(int(runs[run + i * next_row]), i))
        i += 1
    squares[plane * (rows + 2) * (cols + 2) + padded(row, col, cols)] = wp.uint8(side)


_KERNELS = {
    "square_runs": square_runs,
    "square_bits": square_bits,
    "squares_rows": squares_rows,
    "squares_scan": squares_scan,
}


def functions(flags):
    """padded; no flag changes it."""
    return SimpleNamespace(padded=padded)


def make(name, flags):
    """A kernel of this file; no flag changes it."""
    return _KERNELS[name]
