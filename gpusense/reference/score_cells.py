"""Cells of consecutive tables of scores, each with a margin of cells around the map."""

from __future__ import annotations

import numpy as np

from gpusense.interface.structs import ScoreTable


def padded_lines(scores: ScoreTable) -> int:
    """Return the rows of a table with its margin."""
    return scores.rows + 2 * scores.margin


def padded_stride(scores: ScoreTable) -> int:
    """Return the columns of a table with its margin."""
    return scores.cols + 2 * scores.margin


def within(number: np.ndarray, last: int) -> np.ndarray:
    """Return the nearest numbers from 0 to last."""
    return np.minimum(np.maximum(number, 0), last)


def cell_index(scores: ScoreTable, row: np.ndarray, col: np.ndarray, *, across: int = 0) -> np.ndarray:
    """Return the index of a cell in its table; cells beyond the margin have the value of the margin's outer cells."""
    lines, stride = padded_lines(scores), padded_stride(scores)
    line, begin = within(row + scores.margin, lines - 1), within(col + scores.margin, stride - 1)
    return begin * lines + line if across else line * stride + begin
