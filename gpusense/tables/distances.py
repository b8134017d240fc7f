"""What is made of a map on the device before any particle is scored: distances and empty rectangles.

Processors get few long work-items, GPUs one per cell, from a map of bits that the host packs: an eighth of the bytes.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from gpusense._util import checks
from gpusense.backends import Backend, Selection, get_backend
from gpusense.backends.base import Buffer
from gpusense.world.windows import LONGEST_SIDE, Region

_INT = np.dtype(np.int32)
_BYTE = np.dtype(np.uint8)
_SHORT = np.dtype(np.uint16)
_NOTHING: frozenset[str] = frozenset()
# Kernels count cells of four padded planes in 32 bits.
_MOST_CELLS = (1 << 31) // 4 - 1
# The kernel files ``distance`` and ``rectangles`` have the same numbers.
NO_OBSTACLE = (1 << 31) - 1
_BLOCK_ROWS = 32
RECTANGLE_REACH = 254
_STACK = 1024


def check_size(rows: int, cols: int) -> None:
    """Refuse maps whose tables cannot be indexed.

    Raises:
        ValueError: more than 536 million padded cells.
    """
    if (rows + 4) * (cols + 4) > _MOST_CELLS:
        raise ValueError(f"grid: the part in use must have at most {_MOST_CELLS} cells, got {rows} x {cols}")


def packed(obstacles: np.ndarray) -> np.ndarray:
    """(rows, words) int32 bits of a (rows, cols) map; the kernel file ``bits`` says how."""
    rows, cols = obstacles.shape
    if cols % 32 == 0:
        bits = np.packbits(np.ascontiguousarray(obstacles), bitorder="little").reshape(rows, cols // 8)
    else:
        bits = np.zeros((rows, -(-cols // 32) * 4), _BYTE)
        bits[:, : -(-cols // 8)] = np.packbits(obstacles, axis=1, bitorder="little")
    return bits.view("<i4").astype(_INT, copy=False)


def squared_distances(backend: Backend, obstacles: np.ndarray, most: int = NO_OBSTACLE) -> Buffer:
    """Squared cell distance from each cell's centre to the nearest obstacle's, exactly; 2^31 - 1 without obstacles.

    Args:
        backend: The device.
        obstacles: (rows, cols) bool.
        most: Larger squared distances may be anything above this, which spares GPUs the search for them.

    Raises:
        ValueError: more cells or longer sides than the kernels can count.
    """
    rows, cols = obstacles.shape
    check_size(rows, cols)
    if max(rows, cols) > LONGEST_SIDE:
        raise ValueError(
            f"grid: the part in use must have at most {LONGEST_SIDE} rows and columns, got {rows} x {cols}"
        )
    squared = backend.empty(rows * cols, _INT)
    (_by_lines if backend.info.kind == "cpu" else _by_cells)(backend, obstacles, squared, most)
    backend.synchronize()
    return squared


def _by_lines(backend: Backend, obstacles: np.ndarray, squared: Buffer, most: int) -> None:
    """A work-item a line. Rows come last, which is how memory runs."""
    rows, cols = obstacles.shape
    occupied = backend.upload(_bytes(obstacles))
    along, starts = (backend.empty(rows * cols, _INT) for _ in range(2))
    backend.compile("distance_lines", _NOTHING)((cols,), occupied, along, cols, rows, 1, cols)
    backend.compile("distance_envelope", _NOTHING)((rows,), along, starts, squared, rows, cols, cols, 1)


def _by_cells(backend: Backend, obstacles: np.ndarray, squared: Buffer, most: int) -> None:
    """A work-item a cell."""
    rows, cols = obstacles.shape
    words, blocks = -(-cols // 32), -(-rows // _BLOCK_ROWS)
    bits = backend.upload(packed(obstacles))
    nearest, least = backend.empty(rows * cols, _SHORT), backend.empty(blocks * cols, _SHORT)
    reach = min(math.isqrt(most), LONGEST_SIDE)
    backend.compile("distance_bits", _NOTHING)((cols, rows), bits, nearest, rows, cols, words, reach)
    backend.compile("distance_blocks", _NOTHING)((cols, blocks), nearest, least, rows, cols, blocks)
    search = backend.compile("distance_search", _NOTHING)
    search((cols, rows), nearest, least, squared, rows, cols, blocks, most)


def sectors_of(backend: Backend, rows: int, cols: int) -> int:
    """Sectors of each quadrant for which rectangles are made: more make steps longer, and tables larger.

    GPUs gain most, since neighbouring rays wait for the slowest; kernels count cells of all planes in 32 bits.
    """
    wanted = {"gpu": 4, "cpu": 2}[backend.info.kind] if backend.info.backend != "numpy" else 1
    planes = 4 * (rows + 4) * (cols + 4)
    while wanted > 1 and (planes * wanted >= 1 << 31 or 2 * planes * wanted > backend.info.max_buffer):
        wanted //= 2
    return wanted


def empty_rectangles(
    backend: Backend,
    obstacles: np.ndarray,
    sectors: int,
    rectangles: Buffer | None = None,
    changed: Region | None = None,
) -> Buffer:
    """Padded planes of empty rectangles; see the kernel file ``rectangles``.

    Args:
        backend: The device.
        obstacles: (rows, cols) bool.
        sectors: Sectors of a quadrant: 1, 2 or 4.
        rectangles: The planes as they were; they are mended in place. None makes them.
        changed: Where obstacles are not what they were.
    """
    rows, cols = obstacles.shape
    check_size(rows, cols)
    if rectangles is None or changed is None:
        rectangles = backend.empty(4 * sectors * (rows + 2) * (cols + 2), _SHORT, zero=True)
        changed = Region(0, 0, rows, cols)
    top, left, bottom, right = changed.row, changed.col, changed.row + changed.rows, changed.col + changed.cols
    # Cells that change begin this far before the changed obstacles, and rectangles from the last of these end this far
    # behind them; the other way round where they grow the other way.
    first, begin = max(top - RECTANGLE_REACH, 0), max(left - RECTANGLE_REACH, 0)
    end = min(right + RECTANGLE_REACH, cols)
    near = obstacles[first : bottom + RECTANGLE_REACH]
    band = len(near)
    runs = backend.empty(2 * band * cols, _BYTE)
    place = (rows, cols, sectors, first, band, top, left, bottom, right)
    if backend.info.kind == "cpu":
        strips, height = -(-(end - begin) // 64), min(changed.rows + RECTANGLE_REACH, rows)
        columns = backend.compile("free_columns", _NOTHING)
        columns((strips, 2), backend.upload(_bytes(near)), runs, band, cols, begin, end)
        stack = backend.empty(_STACK * height, _INT)
        backend.compile("rectangles_rows", _NOTHING)((height, 4), runs, stack, rectangles, *place)
    else:
        words, bits = -(-cols // 32), backend.upload(packed(near))
        backend.compile("free_rows", _NOTHING)((end - begin, band), bits, runs, band, cols, words, begin, end)
        size = (min(changed.cols + RECTANGLE_REACH, cols), min(changed.rows + RECTANGLE_REACH, rows), 4)
        backend.compile("rectangles_scan", _NOTHING)(size, runs, rectangles, *place)
    backend.synchronize()
    return rectangles


def _bytes(obstacles: np.ndarray) -> np.ndarray:
    """1 for an obstacle, contiguous; bool is copied only where it must be."""
    return np.ascontiguousarray(obstacles, dtype=bool).view(_BYTE)


def distance_transform(obstacles: Any, *, backend: Selection = "auto") -> np.ndarray:
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
    cells = checks.as_array("obstacles", obstacles)
    if cells.dtype.kind not in "biu":
        raise TypeError(f"obstacles: must hold bool or integers, got dtype {cells.dtype}")
    if cells.ndim != 2 or cells.size == 0:
        raise ValueError(f"obstacles: shape must be (H, W) with a cell at least, got {checks.shape_text(cells.shape)}")
    if max(cells.shape) > LONGEST_SIDE:
        size = f"{cells.shape[0]} x {cells.shape[1]}"
        raise ValueError(f"obstacles: must have at most {LONGEST_SIDE} rows and columns, got {size}")
    device = get_backend(backend)
    squared = squared_distances(device, cells != 0)
    return device.download(squared, np.empty(cells.shape, _INT))
