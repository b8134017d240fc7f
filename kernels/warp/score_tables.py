"""Tables of scores for searches over poses: pooled, folded, and packed as numbers."""

import warp as wp

from gpusense.interface.constants import TOP

from .prelude import kernel
from .score_cells import ScoreTable, block_index, padded_lines, padded_stride


@kernel
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


@kernel
def fold_scores(table, out, scores, folded, period, step, beyond, unit):
    """Write the losses of every period-th row and column of each padded table as images."""
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
    value = int(beyond)
    if line >= folded.margin and col >= folded.margin and from_line < rows and from_col < cols:
        value = int(table[(source * rows + from_line) * cols + from_col])
    out[(image * lines + line) * stride + col] = wp.uint8((TOP - value) // unit)


@wp.func
def quarters_at(
    table: wp.array(dtype=wp.uint8), scores: ScoreTable, image: wp.int32, line: wp.int32, col: wp.int32, reach: wp.int32
):  # fmt: skip
    """Return the scores of the quarters of a block: upper left, upper right, lower left, lower right."""
    lines = padded_lines(scores)
    stride = padded_stride(scores)
    here = (image * lines + line) * stride
    low = (image * lines + wp.min(line + reach, lines - 1)) * stride
    right = wp.min(col + reach, stride - 1)
    return wp.vec4i(int(table[here + col]), int(table[here + right]), int(table[low + col]), int(table[low + right]))


@wp.func
def packed_losses(most: wp.int32, four: wp.vec4i):
    """Return losses of quarters as bytes of a number."""
    packed = int(0)
    for i in range(4):
        packed = packed | ((most - four[i]) << (8 * i))
    return packed


@kernel
def pack_quarters(table, quarters, scores, reach):
    """Write the losses of the quarters of the block that begins at each cell, relative to the largest score."""
    image, line, col = wp.tid()
    lines = padded_lines(scores)
    stride = padded_stride(scores)
    if col >= stride or line >= lines or image >= scores.tables:
        return
    four = quarters_at(table, scores, image, line, col, reach)
    quarters[(image * lines + line) * stride + col] = packed_losses(wp.max(four), four)


@kernel
def fold_quarters(table, bound, quarters, scores, bounds, folded, period, step, reach, beyond, unit, across):
    """Write the losses of the quarters of blocks as images, relative to the scores in the folded table of bounds."""
    image, line, col = wp.tid()
    lines = padded_lines(folded)
    stride = padded_stride(folded)
    if col >= stride or line >= lines or image >= folded.tables:
        return
    source = image // (period * period)
    row_phase = image // period % period
    col_phase = image % period
    whole_row = line - folded.margin
    whole_col = col - folded.margin
    side = period // step
    from_line = whole_row * period + row_phase
    from_col = whole_col * period + col_phase
    four = wp.vec4i(beyond, beyond, beyond, beyond)
    if whole_row >= 0 and whole_col >= 0 and from_line < padded_lines(scores) and from_col < padded_stride(scores):
        four = quarters_at(table, scores, source, from_line, from_col, reach)
    coarse = (source * side + row_phase // step) * side + col_phase // step
    begin = coarse * padded_lines(bounds) * padded_stride(bounds)
    loss = int(bound[begin + block_index(bounds, whole_row, whole_col, 0, 0)])
    place = line * stride + col
    if across != 0:
        place = col * lines + line
    quarters[image * lines * stride + place] = packed_losses(TOP - unit * loss, four)


@kernel
def pack_rows(table, packed, scores):
    """Write the losses of each cell and the three below it as bytes of a number."""
    image, line, col = wp.tid()
    lines = padded_lines(scores)
    stride = padded_stride(scores)
    if col >= stride or line >= lines or image >= scores.tables:
        return
    four = int(0)
    for i in range(4):
        four = four | (int(table[(image * lines + wp.min(line + i, lines - 1)) * stride + col]) << (8 * i))
    packed[(image * lines + line) * stride + col] = four
