"""Compute squared distances to the nearest obstacle on a device.

Processors run few long work-items, one per line. GPUs run one work-item per cell, on bits that the host packs to save
seven eighths of the transfer.
"""

from __future__ import annotations

import functools
import itertools
import math
from typing import Any

import numpy as np

from gpusense._util import checks
from gpusense.backends import Backend, Selection, get_backend
from gpusense.backends.base import Buffer
from gpusense.backends.workspace import Workspace
from gpusense.world.windows import LONGEST_SIDE

_INT = np.dtype(np.int32)
_SHORT = np.dtype(np.uint16)
_NO_FLAGS: frozenset[str] = frozenset()
# The kernel file ``distance`` has the same numbers.
NO_OBSTACLE = (1 << 31) - 1
_BLOCK_ROWS = 32


def squared_distances(backend: Backend, obstacles: np.ndarray, most: int = NO_OBSTACLE) -> Buffer:
    """Return (rows, cols) exact squared distances to the nearest obstacle [cells^2], int32; 2^31 - 1 without obstacles.

    ``most``: largest squared distance that matters; larger ones may be any number above it, for a shorter search on
    GPUs.
    """
    rows, cols = obstacles.shape
    check_size(rows, cols)
    if max(rows, cols) > LONGEST_SIDE:
        raise ValueError(
            f"grid: the part in use must have at most {LONGEST_SIDE} rows and columns, got {rows} x {cols}"
        )
    marked = backend.upload((as_bytes if backend.info.kind == "cpu" else packed)(obstacles))
    squared = squared_of_stack(backend, Workspace(backend), marked, (rows, cols), 1, most)
    backend.synchronize()
    return squared


def squared_of_stack(
    backend: Backend, space: Workspace, marked: Buffer, shape: tuple[int, int], worlds: int, most: int = NO_OBSTACLE
) -> Buffer:
    """Start computing (rows, worlds, cols) squared distances [cells^2] in maps of one size, whose rows are interleaved.

    ``marked``: obstacles as bytes on a processor, else as bits; ``most``: see ``squared_distances``.
    """
    (rows, cols), compiled = shape, functools.partial(backend.compile, flags=_NO_FLAGS)
    # Along columns, the columns of all maps are those of one map.
    lines, width = rows * worlds, worlds * cols
    squared = space.empty("squared", rows * width, _INT)
    if backend.info.kind == "cpu":
        along, starts = (space.empty(name, rows * width, _INT) for name in ("along", "starts"))
        compiled("distance_lines")((width,), marked, along, width, rows, 1, width)
        compiled("distance_envelope")((lines,), along, starts, squared, lines, cols, cols, 1)
        return squared
    words, blocks, reach = -(-cols // 32), -(-rows // _BLOCK_ROWS), min(math.isqrt(most), LONGEST_SIDE)
    nearest, least = space.empty("nearest", rows * width, _SHORT), space.empty("least", blocks * width, _SHORT)
    compiled("distance_bits")((cols, lines), marked, nearest, lines, cols, words, reach)
    compiled("distance_blocks")((width, blocks), nearest, least, rows, width, blocks)
    compiled("distance_search")((width, rows), nearest, least, squared, rows, width, blocks, most)
    return squared


def distance_transform(
    obstacles: Any, *, resolution: float = 1.0, squared: bool = False, backend: Selection = "auto"
) -> np.ndarray:
    """Compute the exact Euclidean distance from each cell's centre to the nearest obstacle's centre.

    Args:
        obstacles: (H, W) bool or integers; nonzero cells are obstacles.
        resolution: Side of a cell [m], > 0; 1 for distances in cells.
        squared: Return squared distances in cells: integers, independent of ``resolution``.
        backend: The device, see :func:`gpusense.devices`.

    Returns:
        (H, W) float64 distances [m], equal to ``resolution * scipy.ndimage.distance_transform_edt(~obstacles)``; inf
        everywhere without obstacles. If ``squared``, (H, W) int32 squared distances [cells^2]; 2^31 - 1 everywhere
        without obstacles.

    Raises:
        ValueError: The array is not two-dimensional, is empty, or is too large; or ``resolution`` is not > 0.
        TypeError: The array holds neither bool nor integers, or an option has the wrong type.

    Example:
        >>> import gpusense as gs
        >>> gs.distance_transform([[1, 0, 0], [0, 0, 0]], resolution=0.5, backend="numpy").round(3).tolist()
        [[0.0, 0.5, 1.0], [0.5, 0.707, 1.118]]
        >>> gs.distance_transform([[1, 0, 0], [0, 0, 0]], squared=True, backend="numpy").tolist()
        [[0, 1, 4], [1, 2, 5]]
    """
    side = checks.real("resolution", resolution, above=0)
    checks.boolean("squared", squared)
    cells = checks.as_array("obstacles", obstacles)
    if cells.dtype.kind not in "biu":
        raise TypeError(f"obstacles: must hold bool or integers, got dtype {cells.dtype}")
    if cells.ndim != 2 or cells.size == 0:
        raise ValueError(f"obstacles: shape must be (H, W) with a cell at least, got {checks.shape_text(cells.shape)}")
    if max(cells.shape) > LONGEST_SIDE:
        size = f"{cells.shape[0]} x {cells.shape[1]}"
        raise ValueError(f"obstacles: must have at most {LONGEST_SIDE} rows and columns, got {size}")
    device = get_backend(backend)
    squares = device.download(squared_distances(device, cells != 0), np.empty(cells.shape, _INT))
    if squared:
        return squares
    distances: np.ndarray = np.sqrt(squares) * side
    distances[squares == NO_OBSTACLE] = np.inf
    return distances


# ---- convert occupied cells to the kernels' layouts: bytes, packed bits or distances; and limit their number


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
