"""Convert occupied cells to the kernels' layouts: bytes, packed bits or distances; and limit their number."""

from __future__ import annotations

import itertools

import numpy as np

_INT = np.dtype(np.int32)
_BYTE = np.dtype(np.uint8)
# Kernels index the cells of four padded planes in 32 bits.
_MOST_CELLS = (1 << 31) // 4 - 1


def check_size(rows: int, cols: int) -> None:
    """Check that kernels can index the tables of a window."""
    if (rows + 4) * (cols + 4) > _MOST_CELLS:
        raise ValueError(f"grid: the part in use must have at most {_MOST_CELLS} cells, got {rows} x {cols}")


def as_bytes(obstacles: np.ndarray) -> np.ndarray:
    """Return a contiguous array with byte 1 for an obstacle; contiguous bools are not copied."""
    return np.ascontiguousarray(obstacles, dtype=bool).view(_BYTE)


def packed(obstacles: np.ndarray) -> np.ndarray:
    """Pack a (rows, cols) map into (rows, words) int32 bits; the kernel file ``bits`` defines the layout."""
    rows, cols = obstacles.shape
    if cols % 32 == 0:
        bits = np.packbits(np.ascontiguousarray(obstacles), bitorder="little").reshape(rows, cols // 8)
    else:
        bits = np.zeros((rows, -(-cols // 32) * 4), _BYTE)
        bits[:, : -(-cols // 8)] = np.packbits(obstacles, axis=1, bitorder="little")
    return bits.view("<i4").astype(_INT, copy=False)


def chebyshev_distances(blocked: np.ndarray, longest: int) -> np.ndarray:
    """Return the Chebyshev distance from each cell to the nearest blocked cell, or ``longest``, at most 254: uint8."""
    distances = np.where(blocked, _BYTE.type(0), _BYTE.type(longest))
    # The nearest cell is at most as far across as along, either by rows or by columns.
    return np.minimum(_within_columns(distances), _within_columns(distances.T).T)


def _within_columns(distances: np.ndarray) -> np.ndarray:
    """Spread distances from row to row, down and up at once, by at most a column for each row."""
    both = np.stack([distances, distances[::-1]], axis=1)
    near = np.empty_like(both[0])
    for before, here in itertools.pairwise(both):
        near[:] = before
        np.minimum(near[:, 1:], before[:, :-1], out=near[:, 1:])
        np.minimum(near[:, :-1], before[:, 1:], out=near[:, :-1])
        near += 1
        np.minimum(here, near, out=here)
    return np.minimum(both[:, 0], both[::-1, 1])
