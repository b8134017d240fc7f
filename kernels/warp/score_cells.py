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
def within(number: wp.int32, last: wp.int32):
    """Return the nearest number from 0 to last."""
    return wp.min(wp.max(number, 0), last)


@wp.func
def block_index(scores: ScoreTable, row: wp.int32, col: wp.int32, rows: wp.int32, cols: wp.int32):
    """Return the index of a cell in its table, from which cells up to rows lines and cols columns further are read."""
    stride = padded_stride(scores)
    line = within(row + scores.margin, padded_lines(scores) - 1 - rows)
    return line * stride + within(col + scores.margin, stride - 1 - cols)
