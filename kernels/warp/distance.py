"""Exact squared Euclidean distance transform in cells (Meijster, Roerdink and Hesselink 2000): all integers.

Processors take a work-item a line, whose work grows with its length alone. A pass works on parallel lines of a grid:
line i starts at i * line_stride, its cells are step apart. GPUs, which want more work-items than a map has lines, take
one a cell: it looks around itself only as far as something nearer may be. The grid has fewer than 2^31 cells, so
indices fit int32.
"""

import warp as wp

from .bits import cells_left, cells_right
from .prelude import kernel

NO_OBSTACLE = wp.constant(-1)
UNREACHABLE = wp.constant(0x7FFFFFFF)


# First pass, one work-item a line: cells to the nearest occupied cell of the same line, NO_OBSTACLE without one.
@kernel
def distance_lines(
    occupied: wp.array(dtype=wp.uint8),
    along: wp.array(dtype=wp.int32),
    lines: wp.int32,
    length: wp.int32,
    line_stride: wp.int32,
    step: wp.int32,
):
    line = wp.tid()
    if line >= lines:
        return
    begin = line * line_stride
    nearest = int(NO_OBSTACLE)
    for i in range(length):
        if occupied[begin + i * step] != wp.uint8(0):
            nearest = i
        if nearest == NO_OBSTACLE:
            along[begin + i * step] = NO_OBSTACLE
        else:
            along[begin + i * step] = i - nearest
    nearest = int(NO_OBSTACLE)
    for i in range(length - 1, -1, -1):
        if occupied[begin + i * step] != wp.uint8(0):
            nearest = i
        if nearest != NO_OBSTACLE:
            before = along[begin + i * step]
            after = nearest - i
            if before == NO_OBSTACLE or after < before:
                along[begin + i * step] = after


# Squared distance from cell i to the obstacle nearest to cell j across the lines.
@wp.func
def parabola(i: wp.int32, j: wp.int32, across: wp.int32):
    return (i - j) * (i - j) + across * across


# Second pass, one work-item a line: lower envelope of the parabolas of the first pass. The vertices wait in
# squared, which a line overwrites from its far end: entry q of the stack never lies beyond the cell that reads it.
@kernel
def distance_envelope(
    along: wp.array(dtype=wp.int32),
    starts: wp.array(dtype=wp.int32),
    squared: wp.array(dtype=wp.int32),
    lines: wp.int32,
    length: wp.int32,
    line_stride: wp.int32,
    step: wp.int32,
):
    line = wp.tid()
    if line >= lines:
        return
    first = line * line_stride
    top = int(-1)
    for i in range(length):
        g = along[first + i * step]
        if g != NO_OBSTACLE:
            begin = int(0)
            while top >= 0:
                v = squared[first + top * step]
                gv = along[first + v * step]
                s = starts[first + top * step]
                if parabola(s, v, gv) <= parabola(s, i, g):
                    # The parabolas cross at s or later, so nothing here is negative and division truncates.
                    begin = (i * i - v * v + g * g - gv * gv) // (2 * (i - v)) + 1
                    break
                top -= 1
            if begin < length:
                top += 1
                squared[first + top * step] = i
                starts[first + top * step] = wp.where(top == 0, 0, begin)
    for i in range(length - 1, -1, -1):
        if top < 0:
            squared[first + i * step] = UNREACHABLE
        else:
            v = squared[first + top * step]
            s = starts[first + top * step]
            squared[first + i * step] = parabola(i, v, along[first + v * step])
            if s == i:
                top -= 1


# ---- a work-item a cell

# Beyond all distances: the sum of its square and a distance's fits into 32 bits, without a sign.
FAR = wp.constant(46341)
BLOCK_BITS = wp.constant(5)
BLOCK_ROWS = wp.constant(32)
# Rows looked at between two decisions, so that reads need not wait for one another.
STEP_ROWS = wp.constant(4)


# First pass, one work-item a cell: cells to the nearest occupied cell of the same row, FAR if it is over reach.
@kernel
def distance_bits(
    bits: wp.array(dtype=wp.int32),
    nearest: wp.array(dtype=wp.uint16),
    rows: wp.int32,
    cols: wp.int32,
    words: wp.int32,
    reach: wp.int32,
):
    row, col = wp.tid()
    if row >= rows or col >= cols:
        return
    left = cells_left(bits, row * words, col, reach)
    cells = wp.min(left, cells_right(bits, row * words, words, col, wp.min(left, reach)))
    if cells > reach:
        cells = FAR
    nearest[row * cols + col] = wp.uint16(cells)


# One work-item a column of a block of rows: the least of its numbers.
@kernel
def distance_blocks(
    nearest: wp.array(dtype=wp.uint16),
    blocks: wp.array(dtype=wp.uint16),
    rows: wp.int32,
    cols: wp.int32,
    count: wp.int32,
):
    block, col = wp.tid()
    if block >= count or col >= cols:
        return
    least = int(FAR)
    for row in range(block * BLOCK_ROWS, wp.min((block + 1) * BLOCK_ROWS, rows)):
        least = wp.min(least, int(nearest[row * cols + col]))
    blocks[block * cols + col] = wp.uint16(least)


# Sum of two squares.
@wp.func
def squares_sum(a: wp.uint32, b: wp.uint32):
    return a * a + b * b


# Second pass, one work-item a cell: the least sum of squares along its column, UNREACHABLE if it is over most. Near
# rows are looked at one by one. Of farther ones the blocks' least numbers give first a bound from above, and then which
# blocks may hold less.
@kernel
def distance_search(
    nearest: wp.array(dtype=wp.uint16),
    blocks: wp.array(dtype=wp.uint16),
    squared: wp.array(dtype=wp.int32),
    rows: wp.int32,
    cols: wp.int32,
    count: wp.int32,
    most: wp.int32,
):
    row, col = wp.tid()
    if row >= rows or col >= cols:
        return
    # One more than may be found.
    best = wp.min(squares_sum(wp.uint32(0), wp.uint32(nearest[row * cols + col])), wp.uint32(most) + wp.uint32(1))
    i = int(1)
    while i <= BLOCK_ROWS and wp.uint32(i * i) < best:
        for k in range(STEP_ROWS):
            j = i + k
            if j <= row:
                best = wp.min(best, squares_sum(wp.uint32(j), wp.uint32(nearest[(row - j) * cols + col])))
            if row + j < rows:
                best = wp.min(best, squares_sum(wp.uint32(j), wp.uint32(nearest[(row + j) * cols + col])))
        i += STEP_ROWS
    # Blocks begin beyond what has been seen, so all rows of a block lie on one side.
    step = int(4)
    if wp.uint32(i * i) < best:
        step = 0
    while step < 4:
        way = 2 * (step & 1) - 1
        b = (row + way * i) >> BLOCK_BITS
        while b >= 0 and b < count:
            begin = b * BLOCK_ROWS
            end = wp.min(begin + BLOCK_ROWS, rows) - 1
            near = wp.max(wp.where(way > 0, begin - row, row - end), i)
            far = wp.where(way > 0, end - row, row - begin)
            if wp.uint32(near * near) >= best:
                break
            least = wp.uint32(blocks[b * cols + col])
            if step < 2:
                best = wp.min(best, squares_sum(wp.uint32(far), least) + wp.uint32(1))
            elif squares_sum(wp.uint32(near), least) < best:
                n = near
                while n <= far:
                    number = wp.uint32(nearest[(row + way * n) * cols + col])
                    best = wp.min(best, squares_sum(wp.uint32(n), number))
                    n += 1
            b += way
        step += 1
    result = int(UNREACHABLE)
    if best <= wp.uint32(most):
        result = int(best)
    squared[row * cols + col] = result


_KERNELS = {
    "distance_lines": distance_lines,
    "distance_envelope": distance_envelope,
    "distance_bits": distance_bits,
    "distance_blocks": distance_blocks,
    "distance_search": distance_search,
}


def make(name, flags):
    """A kernel of this file; no flag changes it."""
    return _KERNELS[name]
