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


def cell_index(scores: ScoreTable, row: np.ndarray, col: np.ndarray) -> np.ndarray:
    """Return the index of a cell in its table; cells beyond the margin have the value of the margin's outer cells."""
    line = np.minimum(np.maximum(row, -scores.margin), scores.rows + scores.margin - 1) + scores.margin
    begin = np.minimum(np.maximum(col, -scores.margin), scores.cols + scores.margin - 1) + scores.margin
    return line * padded_stride(scores) + begin
