"""Compute empty rectangles of a map on a device for the exact caster, and refresh them after changes.

Processors run few long work-items, one per row. GPUs run one work-item per cell, on bits that the host packs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gpusense.backends import Backend
from gpusense.backends.base import Buffer
from gpusense.tables.cells import as_bytes, check_size, packed
from gpusense.world.windows import Window

_INT = np.dtype(np.int32)
_BYTE = np.dtype(np.uint8)
_SHORT = np.dtype(np.uint16)
_NO_FLAGS: frozenset[str] = frozenset()
# The kernel file ``rectangles`` has the same numbers.
RECTANGLE_REACH = 254
_STACK = 1024
# Rows of a group.
ROWS = 8
# Largest maps on GPUs with planes of single rows, and with four sectors [cells].
_CACHED = 1 << 24
_FOUR_SECTORS = 1 << 25


@dataclass(frozen=True)
class Planes:
    """Storage layout of empty rectangles.

    Attributes:
        sectors: Sectors per quadrant: 1, 2 or 4. More sectors make steps longer and tables larger.
        group: Rows of a group: 1, or ``ROWS`` on GPUs.
    """

    sectors: int
    group: int = 1

    def __post_init__(self) -> None:
        if self.group not in (1, ROWS):
            raise ValueError(f"group: must be 1 or {ROWS}, got {self.group}")

    @property
    def flags(self) -> frozenset[str]:
        """Flags of the kernels that read the planes."""
        groups = ("ROW_GROUPS",) if self.group > 1 else ()
        return frozenset({f"SECTORS_{self.sectors}", *groups} if self.sectors > 1 else groups)

    def lines(self, rows: int) -> int:
        """Return the number of rows of a plane for a map of ``rows`` rows, including the ring and whole groups."""
        return -(-(rows + 2) // self.group) * self.group

    def entries(self, rows: int, cols: int) -> int:
        """Return the number of rectangles of all planes of a map."""
        return 4 * self.sectors * self.lines(rows) * (cols + 2)


def planes_of(backend: Backend, rows: int, cols: int) -> Planes:
    """Return the planes of a map on a device.

    GPUs gain most from sectors, since a warp waits for its slowest ray. Memory limits rays once planes exceed a GPU's
    caches, and groups of rows halve the reads; on larger maps four sectors are no faster than two and take twice the
    memory. Kernels index the cells of all planes in 32 bits, which limits the sectors.
    """
    gpu, cells = backend.info.kind == "gpu", rows * cols
    sectors = 1 if backend.info.backend == "numpy" else 4 if gpu and cells <= _FOUR_SECTORS else 2
    while sectors > 1 and (
        4 * sectors * (rows + ROWS + 2) * (cols + 4) >= 1 << 31
        or 8 * sectors * (rows + ROWS + 2) * (cols + 4) > backend.info.max_buffer
    ):
        sectors //= 2
    return Planes(sectors, ROWS if gpu and cells > _CACHED else 1)


def empty_rectangles(
    backend: Backend,
    obstacles: np.ndarray,
    planes: Planes,
    rectangles: Buffer | None = None,
    changed: Window | None = None,
) -> Buffer:
    """Compute or refresh the padded planes of empty rectangles; the kernel file ``rectangles`` defines them."""
    if planes.group > 1 and backend.info.kind == "cpu":
        raise ValueError(f"planes: must have single rows on a processor, got groups of {planes.group}")
    rows, cols = obstacles.shape
    check_size(rows, cols)
    if rectangles is None or changed is None:
        rectangles = backend.empty(planes.entries(rows, cols), _SHORT, zero=True)
        changed = Window(0, 0, rows, cols)
    top, left, bottom, right = changed.row, changed.col, changed.row + changed.rows, changed.col + changed.cols
    # In both directions, changed rectangles begin at most RECTANGLE_REACH cells before the changed obstacles, and end
    # at most as far behind them.
    first, begin = max(top - RECTANGLE_REACH, 0), max(left - RECTANGLE_REACH, 0)
    end = min(right + RECTANGLE_REACH, cols)
    near = obstacles[first : bottom + RECTANGLE_REACH]
    band = len(near)
    runs = backend.empty(2 * band * cols, _BYTE)
    place = (rows, cols, planes.sectors, first, band, top, left, bottom, right)
    if backend.info.kind == "cpu":
        strips, height = -(-(end - begin) // 64), min(changed.rows + RECTANGLE_REACH, rows)
        columns = backend.compile("free_columns", _NO_FLAGS)
        columns((strips, 2), backend.upload(as_bytes(near)), runs, band, cols, begin, end)
        stack = backend.empty(_STACK * height, _INT)
        backend.compile("rectangles_rows", _NO_FLAGS)((height, 4), runs, stack, rectangles, *place)
    else:
        words, bits = -(-cols // 32), backend.upload(packed(near))
        backend.compile("free_rows", _NO_FLAGS)((end - begin, band), bits, runs, band, cols, words, begin, end)
        size = (min(changed.cols + RECTANGLE_REACH, cols), min(changed.rows + RECTANGLE_REACH, rows), 4)
        backend.compile("rectangles_scan", _NO_FLAGS)(size, runs, rectangles, *place, planes.lines(rows), planes.group)
    backend.synchronize()
    return rectangles
