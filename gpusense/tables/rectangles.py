"""Compute empty rectangles of a map on a device for the exact caster, and refresh them after changes.

Processors run few long work-items, one per row. GPUs run a work-item for each sector of 64 cells of a column, on bits
that the host packs.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gpusense.backends import Backend
from gpusense.backends.base import Buffer
from gpusense.backends.workspace import Workspace
from gpusense.interface.constants import RECTANGLE_REACH
from gpusense.tables.distances import as_bytes, check_size, packed
from gpusense.tables.world_cells import Stack, Table
from gpusense.tables.worlds import Worlds
from gpusense.world.windows import Window

_INT = np.dtype(np.int32)
_BYTE = np.dtype(np.uint8)
_SHORT = np.dtype(np.uint16)
_NO_FLAGS: frozenset[str] = frozenset()
# Numbers of a row's stacks; the kernel file ``rectangles`` has the same number.
_STACK = 1024
# Least cells of a column that a work-item of a GPU takes, and number of work-items that fill any GPU. Where a column
# begins, its work-item has to find a rectangle from nothing.
_TALL, _ENOUGH = 64, 1 << 19
# Rows of a group.
ROWS = 8
# Largest maps on GPUs with planes of single rows, and with four sectors [cells].
_CACHED = 1 << 24
_FOUR_SECTORS = 1 << 25


@dataclass(frozen=True)
class Planes:
    """Storage layout of empty rectangles."""

    sectors: int  # sectors per quadrant: 1, 2 or 4. More sectors make steps longer and tables larger.
    group: int = 1  # rows of a group: 1 or ``ROWS``

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


def planes_of(backend: Backend, rows: int, cols: int, all_cells: int = 0) -> Planes:
    """Return the planes of a map on a device.

    GPUs gain most from sectors, since a warp waits for its slowest ray. Memory limits rays once planes exceed a GPU's
    caches, and groups of rows halve the reads; on larger maps four sectors are no faster than two and take twice the
    memory. Kernels index the cells of all planes in 32 bits, which limits the sectors.
    """
    gpu, cells = backend.info.kind == "gpu", max(rows * cols, all_cells)
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
    space, place = Workspace(backend), backend.empty(1, _INT, zero=True)
    changed_part = (rows, cols, planes.sectors, first, band, top, left, bottom, right)
    marked = backend.upload((as_bytes if backend.info.kind == "cpu" else packed)(near))
    _make(backend, space, marked, place, rectangles, planes, changed_part, (begin, end), 1)
    backend.synchronize()
    return rectangles


def rectangles_of_worlds(worlds: Worlds, unknown: str) -> tuple[Table, frozenset[str]]:
    """Return the planes of empty rectangles of all worlds, which models share, and their flags."""
    backend = worlds.backend
    rows, cols = worlds.shape
    chosen = planes_of(backend, rows, cols, worlds.cells)
    sectors, group = chosen.sectors, chosen.group
    if len(worlds) > 1:
        # Each of several worlds is read into the caches anew, so smaller tables are faster, and on processors also
        # planes of which rays read fewer lines of the caches.
        sectors, group = (1, ROWS) if backend.info.kind == "cpu" else (min(sectors, 2), group)
    while sectors > 1 and 8 * sectors * worlds.cells > worlds.largest_table:
        sectors //= 2
    planes = Planes(sectors, group)

    def fill(stack: Stack, table: Buffer) -> None:
        marked, _ = worlds.marked(stack, unknown)
        whole = (stack.rows, stack.cols, planes.sectors, 0, stack.rows, 0, 0, stack.rows, stack.cols)
        _make(backend, stack.space, marked, stack.place, table, planes, whole, (0, stack.cols), stack.worlds)

    def make() -> Table:
        each = 4 * planes.sectors
        return Table(worlds.allocate(each, _SHORT), 2 * each * worlds.cells, fill)

    return worlds.table(("rectangles", unknown), make), planes.flags


def _make(
    backend: Backend,
    space: Workspace,
    marked: Buffer,
    place: Buffer,
    rectangles: Buffer,
    planes: Planes,
    changed_part: tuple[int, ...],
    columns: tuple[int, int],
    worlds: int,
) -> None:
    """Start the launches that make planes of some worlds.

    ``space``: memory of runs and stacks; ``marked``: obstacles of a band of rows, with the worlds' lines interleaved:
    bytes on a processor, else bits; ``place``: first cell of each world in tables with a ring; ``changed_part``: rows,
    columns, sectors, the band's first row and its rows, and the changed window; ``columns``: the first column of runs
    and the one after the last.
    """
    rows, cols, sectors, _, band, top, left, bottom, right = changed_part
    begin, end = columns
    runs = space.empty("runs", 2 * band * cols * worlds, _BYTE)
    if backend.info.kind == "cpu":
        # Columns are independent, so the columns of all worlds form one map.
        first, last = (begin, end) if worlds == 1 else (0, cols * worlds)
        strips, height = -(-(last - first) // 64), min(bottom - top + RECTANGLE_REACH, rows)
        columns_kernel = backend.compile("free_columns", _NO_FLAGS)
        columns_kernel((strips, 2), marked, runs, band, cols * worlds, first, last)
        stack = space.empty("stack", _STACK * height * worlds, _INT)
        rows_kernel = backend.compile("rectangles_rows", _NO_FLAGS)
        layout = (planes.lines(rows), planes.group)
        rows_kernel((height, 4 * worlds), runs, place, stack, rectangles, *changed_part, worlds, *layout)
        return
    words, lines = -(-cols // 32), band * worlds
    quads = -(-(end - begin) // 4)
    backend.compile("free_rows", _NO_FLAGS)((quads, lines), marked, runs, lines, cols, words, begin, end)
    height, width = min(bottom - top + RECTANGLE_REACH, rows), min(right - left + RECTANGLE_REACH, cols)
    tall = _TALL
    while tall < height and -(-height // (2 * tall)) * sectors * 4 * worlds * width >= _ENOUGH:
        tall *= 2
    # Tiles begin at multiples of four rows of a padded plane, and the last has up to twice as many.
    size = (width, max((height + 3) // tall, 1) * sectors, 4 * worlds)
    scan = backend.compile("rectangles_scan", _NO_FLAGS)
    scan(size, runs, place, rectangles, *changed_part, worlds, planes.lines(rows), planes.group, tall)
