"""What is made of a map on the device before any particle is scored: distances and quadrant squares."""

from __future__ import annotations

from typing import Any

import numpy as np

from gpusense import _checks
from gpusense.backends import Backend, get_backend
from gpusense.backends.base import Buffer
from gpusense.region import LONGEST_SIDE

_INT = np.dtype(np.int32)
_BYTE = np.dtype(np.uint8)
# Kernels count cells of four padded planes in 32 bits.
_MOST_CELLS = (1 << 31) // 4 - 1


def check_size(rows: int, cols: int) -> None:
    """Refuse maps whose tables cannot be indexed.

    Raises:
        ValueError: more than 536 million padded cells.
    """
    if (rows + 4) * (cols + 4) > _MOST_CELLS:
        raise ValueError(f"grid: the part in use must have at most {_MOST_CELLS} cells, got {rows} x {cols}")


def squared_distances(backend: Backend, obstacles: np.ndarray) -> Buffer:
    """Squared cell distance from each cell's centre to the nearest obstacle's, exactly; 2^31 - 1 without obstacles.

    Processors walk rows last, which is how memory runs; on a GPU neighbouring work-items take neighbouring columns.

    Raises:
        ValueError: more cells or longer sides than the kernels can count.
    """
    rows, cols = obstacles.shape
    check_size(rows, cols)
    if max(rows, cols) > LONGEST_SIDE:
        raise ValueError(
            f"grid: the part in use must have at most {LONGEST_SIDE} rows and columns, got {rows} x {cols}"
        )
    count = rows * cols
    occupied = backend.upload(np.ascontiguousarray(obstacles, dtype=_BYTE))
    along, starts, squared = (backend.empty(count, _INT) for _ in range(3))
    by_column, by_row = (cols, rows, 1, cols), (rows, cols, cols, 1)
    first, second = (by_column, by_row) if backend.info.kind == "cpu" else (by_row, by_column)
    backend.compile("distance_lines", frozenset())((first[0],), occupied, along, *first)
    backend.compile("distance_envelope", frozenset())((second[0],), along, starts, squared, *second)
    backend.synchronize()
    return squared


def quadrant_squares(backend: Backend, obstacles: np.ndarray) -> Buffer:
    """Padded planes of quadrant empty squares; see the kernel file ``squares``."""
    rows, cols = obstacles.shape
    check_size(rows, cols)
    occupied = backend.upload(np.ascontiguousarray(obstacles, dtype=_BYTE))
    runs = backend.empty(2 * rows * cols, _BYTE)
    squares = backend.empty(4 * (rows + 2) * (cols + 2), _BYTE, zero=True)
    backend.compile("square_runs", frozenset())((rows, 2), occupied, runs, rows, cols)
    if backend.info.kind == "cpu":
        backend.compile("squares_rows", frozenset())((4,), runs, squares, rows, cols)
    else:
        backend.compile("squares_scan", frozenset())((rows * cols, 4), runs, squares, rows, cols)
    backend.synchronize()
    return squares


def distance_transform(obstacles: Any, *, backend: str | Backend = "auto") -> np.ndarray:
    """Exact squared Euclidean distance transform.

    Args:
        obstacles: (H, W) bool or integers; what is not 0 is an obstacle.
        backend: Where it runs.

    Returns:
        (H, W) int32, squared distance in cells from each cell's centre to the nearest obstacle's; 2^31 - 1 everywhere
        when there is no obstacle. Equal to the square of ``scipy.ndimage.distance_transform_edt(~obstacles)``.

    Raises:
        ValueError: the array is not two-dimensional, has no cell, or is too large.
        TypeError: it holds neither bool nor integers.
    """
    cells = _checks.as_array("obstacles", obstacles)
    if cells.dtype.kind not in "biu":
        raise TypeError(f"obstacles: must hold bool or integers, got dtype {cells.dtype}")
    if cells.ndim != 2 or cells.size == 0:
        raise ValueError(f"obstacles: shape must be (H, W) with a cell at least, got {_checks.shape_text(cells.shape)}")
    if max(cells.shape) > LONGEST_SIDE:
        size = f"{cells.shape[0]} x {cells.shape[1]}"
        raise ValueError(f"obstacles: must have at most {LONGEST_SIDE} rows and columns, got {size}")
    device = get_backend(backend)
    squared = squared_distances(device, cells != 0)
    return device.download(squared, np.empty(cells.shape, _INT))
