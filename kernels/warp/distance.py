"""Exact squared Euclidean distance transform in cells (Meijster, Roerdink and Hesselink 2000), in integers.

On processors a work-item takes a line, in time linear in its length. Lines of a pass are parallel: line i starts at i *
line_stride, and its cells are step apart. GPUs need more work-items than a map has lines: on a GPU a work-item takes a
cell, and stops its search around the cell once no nearer obstacle is possible. The grid has fewer than 2^31 cells, so
indices fit int32.
"""

import warp as wp

from .bits import cells_left, cells_right
from .prelude import kernel

NO_OBSTACLE = -1
UNREACHABLE = 0x7FFFFFFF


@kernel
def distance_lines(occupied, along, lines, length, line_stride, step):
    """First pass: count the cells to the nearest occupied cell of the same line, NO_OBSTACLE without one."""
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


@wp.func
def parabola(i: wp.int32, j: wp.int32, across: wp.int32):
    """Return the squared distance from cell i to the obstacle nearest to cell j across the lines."""
    return (i - j) * (i - j) + across * across


@kernel
def distance_envelope(along, starts, squared, lines, length, line_stride, step):
    """Second pass: evaluate the lower envelope of the parabolas of the first pass."""
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


# Larger than all distances. Its square plus the square of a distance fits into 32 unsigned bits.
FAR = 46341
BLOCK_BITS = 5
BLOCK_ROWS = 32
# Rows read between two decisions, so that reads do not wait for each other.
STEP_ROWS = 4


@kernel
def distance_bits(bits, nearest, rows, cols, words, reach):
    """First pass: count the cells to the nearest occupied cell of the same row, FAR where it is over reach."""
    row, col = wp.tid()
    if row >= rows or col >= cols:
        return
    left = cells_left(bits, row * words, col, reach)
    cells = wp.min(left, cells_right(bits, row * words, words, col, wp.min(left, reach)))
    if cells > reach:
        cells = FAR
    nearest[row * cols + col] = wp.uint16(cells)


@kernel
def distance_blocks(nearest, blocks, rows, cols, count):
    """Find the minimum of each column of a block of rows. One work-item takes a column of a block."""
    block, col = wp.tid()
    if block >= count or col >= cols:
        return
    least = int(FAR)
    for row in range(block * BLOCK_ROWS, wp.min((block + 1) * BLOCK_ROWS, rows)):
        least = wp.min(least, int(nearest[row * cols + col]))
    blocks[block * cols + col] = wp.uint16(least)


@wp.func
def squares_sum(a: wp.uint32, b: wp.uint32):
    """Return the sum of two squares."""
    return a * a + b * b


@kernel
def distance_search(nearest, blocks, squared, rows, cols, count, most):
    """Second pass: find the least sum of squares along the column of a cell, UNREACHABLE where it is over most."""
    row, col = wp.tid()
    if row >= rows or col >= cols:
        return
    # One more than the largest result.
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
    # Blocks begin beyond the rows read so far, so all rows of a block are on one side.
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


@kernel
def fill_field(squared, density, table, rows, cols, cap, beyond, from_col, from_row, width, height, begin, stride):
    """Fill width x height cells of a field's table from squared distances."""
    j, i = wp.tid()
    if i >= width or j >= height:
        return
    col = from_col + i
    row = from_row + j
    value = beyond
    if col >= 0 and col < cols and row >= 0 and row < rows:
        value = density[wp.min(squared[row * cols + col], cap)]
    table[begin + j * stride + i] = value
