"""Cells of consecutive tables of scores, each with a margin of cells around the map."""

import warp as wp

from .prelude import precision

# Columns of a run that a kernel in lanes reads at once; the margin holds one run.
RUN = wp.constant(16)
# The struct has integers only, and so is the same in both precisions.
ScoreTable = precision(frozenset()).ScoreTable


# Return the rows of a table with its margin.
@wp.func
def padded_lines(scores: ScoreTable):
    return scores.rows + 2 * scores.margin


# Return the columns of a table with its margin.
@wp.func
def padded_stride(scores: ScoreTable):
    return scores.cols + 2 * scores.margin


# Return the index of a cell in its table; cells beyond the margin have the value of the margin's outer cells.
@wp.func
def cell_index(scores: ScoreTable, row: wp.int32, col: wp.int32):
    line = wp.min(wp.max(row, -scores.margin), scores.rows + scores.margin - 1) + scores.margin
    begin = wp.min(wp.max(col, -scores.margin), scores.cols + scores.margin - RUN) + scores.margin
    return line * padded_stride(scores) + begin
