"""Exhaustive search over poses: sums of a table's cells over the end points of a scan.

For one heading the end points fall into integer cells, and the cells of all positions on the grid are the same ones,
shifted. The score of a position is the sum of the table over the shifted cells (Olson, Real-time correlative scan
matching, ICRA 2009). A pooled table holds the largest value of a square of positions, so that its sums are upper bounds
of all scores in the square (Hess et al., Real-time loop closure in 2D lidar SLAM, ICRA 2016). All sums are sums of
integers, so a bound is never below a score that it bounds.

Tables are consecutive, each with a margin of cells around the map. An item is a scan at a heading; its points are
first[item] to first[item + 1] - 1, each of which names the table (image) that it reads. A folded table holds every
period-th cell of a table as a separate image: shifts by whole periods read neighbours.
"""

import warp as wp

from .prelude import kernel
from .score_cells import cell_index, padded_lines, padded_stride


# Write the maximum of each cell and the cells up to reach rows and columns further. One work-item takes a cell.
@kernel()
def pool_scores(table, pooled, scores, reach):
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


# Write every period-th row and column of each padded table as an image, for each of period^2 first cells. One work-item
# takes a cell of an image.
@kernel()
def fold_scores(table, out, scores, folded, period, beyond):
    image, line, col = wp.tid()
    lines = padded_lines(folded)
    stride = padded_stride(folded)
    if col >= stride or line >= lines or image >= folded.tables:
        return
    source = image // (period * period)
    phase = image % (period * period)
    from_line = (line - folded.margin) * period + phase // period
    from_col = (col - folded.margin) * period + phase % period
    rows = padded_lines(scores)
    cols = padded_stride(scores)
    value = wp.uint8(beyond)
    if line >= folded.margin and col >= folded.margin and from_line < rows and from_col < cols:
        value = table[(source * rows + from_line) * cols + from_col]
    out[(image * lines + line) * stride + col] = value


# Sum the cells of each item's points at all shifts by less than height rows and width columns. One work-item takes a
# shift of an item.
@kernel()
def shift_scores(table, point, image, first, score, scores, items, height, width):
    item, row, col = wp.tid()
    if col >= width or row >= height or item >= items:
        return
    size = padded_lines(scores) * padded_stride(scores)
    total = int(0)
    for k in range(first[item], first[item + 1]):
        cell = point[k]
        total += int(table[image[k] * size + cell_index(scores, cell.y + row, cell.x + col)])
    score[(item * height + row) * width + col] = total


# Sum the cells of candidates' points; a candidate is an item, and the row and column of its shift. One work-item takes
# a candidate.
@kernel()
def candidate_scores(table, point, image, first, candidate, score, scores, candidates):
    n = wp.tid()
    if n >= candidates:
        return
    item = candidate[3 * n]
    row = candidate[3 * n + 1]
    col = candidate[3 * n + 2]
    size = padded_lines(scores) * padded_stride(scores)
    total = int(0)
    for k in range(first[item], first[item + 1]):
        cell = point[k]
        total += int(table[image[k] * size + cell_index(scores, cell.y + row, cell.x + col)])
    score[n] = total


def make(name, flags):
    """Return a kernel of the file; no flag changes one."""
    return globals()[name]
