"""Cells of consecutive tables of scores, each with a margin of cells around the map."""

import warp as wp

from .types import ScoreTable


@wp.func
def padded_lines(scores: ScoreTable):
    """Return the rows of a table with its margin."""
    return scores.rows + 2 * scores.margin


@wp.func
def padded_stride(scores: ScoreTable):
    """Return the columns of a table with its margin."""
    return scores.cols + 2 * scores.margin


@wp.func
def block_index(scores: ScoreTable, row: wp.int32, col: wp.int32, rows: wp.int32, cols: wp.int32):
    """Return the index of a cell in its table, from which cells up to rows lines and cols columns further are read."""
    line = wp.min(wp.max(row + scores.margin, 0), padded_lines(scores) - 1 - rows)
    begin = wp.min(wp.max(col + scores.margin, 0), padded_stride(scores) - 1 - cols)
    return line * padded_stride(scores) + begin
