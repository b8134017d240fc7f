"""Exhaustive search over poses: sums of a table's cells over the end points of a scan.

For one heading the end points fall into integer cells, and the cells of all positions on the grid are the same ones,
shifted. The score of a position is the sum of the table over the shifted cells (Olson, Real-time correlative scan
matching, ICRA 2009). A pooled table holds the largest value of a square of positions, so that its sums are upper bounds
of all scores in the square (Hess et al., Real-time loop closure in 2D lidar SLAM, ICRA 2016). All sums are sums of
integers, so a bound is never below a score that it bounds.

Tables are consecutive, each with a margin of cells around the map. An item is a scan at a heading; its points are
first[item] to first[item + 1] - 1, each of which names the table (image) that it reads. A folded table holds every
period-th cell of a table as a separate image: shifts by whole periods read neighbours. A run is a number of
neighbouring points that read the same cell.
"""

import warp as wp

from .prelude import kernel
from .score_cells import SHIFT_ROWS, block_index, padded_lines, padded_stride

# Sums of neighbouring rows.
Rows = wp.types.vector(length=SHIFT_ROWS, dtype=wp.int32)


@kernel()
def pool_scores(table, pooled, scores, reach):
    """Write the maximum of each cell and the cells up to reach rows and columns further. One work-item takes a cell."""
    image, line, col = wp.tid()
    lines = padded_lines(scores)
    stride = padded_stride(scores)
    if col >= stride or line >= lines or image >= scores.tables:
        return
    begin = image * lines * stride
    low = begin + wp.min(line + reach, lines - 1) * stride
    right = wp.min(col + reach, stride - 1)
    upper = wp.max(table[begin + line * stride + col], table[begin + line * stride + right])
    lower = wp.max(table[low + col], table[low + right])
    pooled[begin + line * stride + col] = wp.max(upper, lower)


@kernel()
def fold_scores(table, out, scores, folded, period, step, beyond):
    """Write every period-th row and column of each padded table as an image, for each of (period / step)^2 first cells,
    step apart. One work-item takes a cell of an image.
    """
    image, line, col = wp.tid()
    lines = padded_lines(folded)
    stride = padded_stride(folded)
    if col >= stride or line >= lines or image >= folded.tables:
        return
    side = period // step
    source = image // (side * side)
    phase = image % (side * side)
    from_line = (line - folded.margin) * period + phase // side * step
    from_col = (col - folded.margin) * period + phase % side * step
    rows = padded_lines(scores)
    cols = padded_stride(scores)
    value = wp.uint8(beyond)
    if line >= folded.margin and col >= folded.margin and from_line < rows and from_col < cols:
        value = table[(source * rows + from_line) * cols + from_col]
    out[(image * lines + line) * stride + col] = value


@kernel()
def shift_scores(table, run, image, weight, first, runs, allowed, score, scores, begin, items, height, width):
    """Sum the cells of each item's runs at all shifts by less than height rows and width columns; a shift that is not
    allowed has -1. One work-item takes SHIFT_ROWS rows of a column of an item.
    """
    part, block, col = wp.tid()
    item = begin + part
    row = SHIFT_ROWS * block
    if col >= width or row >= height or item >= items:
        return
    some = int(0)
    for i in range(wp.min(SHIFT_ROWS, height - row)):
        some = some + int(allowed[(row + i) * width + col])
    stride = padded_stride(scores)
    size = padded_lines(scores) * stride
    last = first[item]
    if some > 0:
        last = first[item] + runs[item]
    total = Rows()
    for k in range(first[item], last):
        cell = run[k]
        place = image[k] * size + block_index(scores, cell.y + row, cell.x + col, SHIFT_ROWS - 1, 0)
        for i in range(SHIFT_ROWS):
            total[i] = total[i] + weight[k] * int(table[place + i * stride])
    for i in range(SHIFT_ROWS):
        if row + i < height:
            n = (row + i) * width + col
            value = int(-1)
            if allowed[n] > wp.uint8(0):
                value = total[i]
            score[item * height * width + n] = value


@kernel()
def row_maxima(score, best, rows, width):
    """Find the largest score of each row of shifts, and its first column. One work-item takes a row of an item."""
    n = wp.tid()
    if n >= rows:
        return
    most = int(-1)
    place = int(0)
    for col in range(width):
        if score[n * width + col] > most:
            most = score[n * width + col]
            place = col
    best[2 * n] = most
    best[2 * n + 1] = place


@kernel()
def choose_blocks(score, best, low, high, block, count, rows, height, width, turns, level, room, slot):
    """Collect the shifts whose scores are at least low and less than high of their scan, in no certain order: item,
    first row and column of each block, and score. count[slot], which the caller clears, may exceed room: then some
    are left out. best is the result of row_maxima. One work-item takes a row of an item.
    """
    k = wp.tid()
    if k >= rows:
        return
    item = k // height
    least = low[item // turns]
    most = high[item // turns]
    if best[2 * k] < least:
        return
    for col in range(width):
        value = score[k * width + col]
        if value >= least and value < most:
            n = wp.atomic_add(count, slot, 1)
            if n < room:
                block[4 * n] = item
                block[4 * n + 1] = (k % height) << level
                block[4 * n + 2] = col << level
                block[4 * n + 3] = value


@kernel()
def divide_blocks(
    table, above, point, image, first, block, allowed, low, part, count, scores, blocks, height, width, columns, turns,
    level, spacing, slot,
):  # fmt: skip
    """Divide blocks of positions into quarters of 2^level x 2^level, and collect the allowed ones whose scores are at
    least low of their scan, in no certain order. above has the tables of the blocks. The caller clears count[slot].
    One work-item takes a block.
    """
    n = wp.tid()
    if n >= blocks:
        return
    item = block[4 * n]
    row = block[4 * n + 1]
    col = block[4 * n + 2]
    quarter = 1 << level
    stride = padded_stride(scores)
    size = padded_lines(scores) * stride
    reach = spacing * quarter
    last = first[item + 1]
    least = low[item // turns]
    below = reach * stride
    total = wp.vec4i()
    rest = block[4 * n + 3]
    for k in range(first[item], last):
        cell = point[k]
        begin = image[k] * size
        begin += block_index(scores, cell.y + spacing * row, cell.x + spacing * col, reach, reach)
        rest = rest - int(above[begin])
        total[0] = total[0] + int(table[begin])
        total[1] = total[1] + int(table[begin + reach])
        total[2] = total[2] + int(table[begin + below])
        total[3] = total[3] + int(table[begin + below + reach])
        # The remaining points add no more than they do to the block's bound.
        if k % 16 == 15 and wp.max(total) + rest < least:
            return
    for i in range(4):
        part_row = row + i // 2 * quarter
        part_col = col + i % 2 * quarter
        if part_row < height and part_col < width and total[i] >= least:
            if allowed[(part_row >> level) * columns + (part_col >> level)] > wp.uint8(0):
                m = wp.atomic_add(count, slot, 1)
                part[4 * m] = item
                part[4 * m + 1] = part_row
                part[4 * m + 2] = part_col
                part[4 * m + 3] = total[i]


def make(name, flags):
    """Return a kernel of the file; no flag changes one."""
    return globals()[name]
