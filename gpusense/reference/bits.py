"""Rows of a map as bits, 1 where a cell is occupied: 32 cells a word, the first cell in the lowest bit.

Kernels read 32 cells at a time; the reference unpacks all rows and sweeps over them at once.
"""

from __future__ import annotations

import numpy as np

NONE = np.iinfo(np.int32).max


def unpacked(bits: np.ndarray, rows: int, cols: int, words: int) -> np.ndarray:
    """Unpack words to a (rows, cols) array of bool."""
    whole = np.unpackbits(bits[: rows * words].astype("<i4").view(np.uint8), bitorder="little")
    return whole.reshape(rows, 32 * words)[:, :cols].astype(bool)


def cells_right(cells: np.ndarray) -> np.ndarray:
    """Count the cells from each cell to the first occupied one to its right, itself included; NONE without one."""
    index = np.arange(cells.shape[1], dtype=np.int32)
    nearest = np.minimum.accumulate(np.where(cells, index, NONE)[:, ::-1], axis=1)[:, ::-1]
    return np.where(nearest == NONE, NONE, nearest - index)


def cells_left(cells: np.ndarray) -> np.ndarray:
    """Count the cells to the first occupied one to its left."""
    return cells_right(cells[:, ::-1])[:, ::-1]
