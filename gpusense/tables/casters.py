"""Ways to find expected ranges: what each makes of a map, what it gives up, and its knobs.

``RayCaster(method=...)`` and ``BeamModel(caster=...)`` take one of these, or its name for its default knobs.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np

from gpusense._util import checks
from gpusense.backends import Backend
from gpusense.backends.base import Buffer
from gpusense.tables.directional import directional_table
from gpusense.tables.distances import check_size, empty_rectangles, sectors_of, squared_distances
from gpusense.tables.lookup_files import read_lookup
from gpusense.world.windows import Region

_BYTE, _SHORT, _SINGLE = (np.dtype(kind) for kind in (np.uint8, np.uint16, np.float32))
_NO_OBSTACLE = np.iinfo(np.int32).max
# Rays of one launch that fills a look-up table, so that a launch ends in about a second.
_TILE = {"cpu": 1 << 22, "gpu": 1 << 30}


@dataclass(frozen=True)
class Window:
    """The part of a map that a table is made of.

    Attributes:
        obstacles: (rows, cols) bool.
        limit: Longest range in cells.
        outside: Whether what lies outside the grid is ``"free"`` or ``"occupied"``.
    """

    obstacles: np.ndarray
    limit: float
    outside: str


@dataclass(frozen=True)
class Table:
    """What a caster made of a map: a buffer on the device, its size in bytes, and the flags of kernels that read it."""

    buffer: Buffer
    size: int
    flags: frozenset[str] = frozenset()


class Caster(ABC):
    """A way to find expected ranges.

    Attributes:
        name: What names it with its default knobs.
        exact: Whether its ranges are the exact ones.
        error: ``"exact"``, or the bound of its error.
        memory: Bytes on the device.
        precomputation: What is made of the map beforehand.
        knobs: What its error and its time depend on.
        flag: The kernels' flag; empty for the exact caster.
        whole: Whether the table is made of the whole map at once.
        ring: Whether a ring of cells stands for what is outside the grid.
    """

    name: ClassVar[str]
    exact: ClassVar[bool] = False
    error: ClassVar[str]
    memory: ClassVar[str]
    precomputation: ClassVar[str]
    knobs: ClassVar[str] = "none"
    flag: ClassVar[str] = ""
    whole: ClassVar[bool] = False
    ring: ClassVar[bool] = True

    @abstractmethod
    def prepare(self, backend: Backend, window: Window) -> Table:
        """Make the table of a window on a device."""

    def mend(self, backend: Backend, window: Window, table: Buffer, changed: Region) -> bool:
        """Make a table follow obstacles that changed in a part of its window; False where it is to be made anew."""
        return False

    def scalars(self) -> tuple[int, float, float]:
        """The kernels' arguments bins, slack [cells] and tolerance [cells]."""
        return 0, 0.0, 0.0


@dataclass(frozen=True)
class Exact(Caster):
    """A walk that crosses a whole empty rectangle at a time."""

    name = "exact"
    exact = True
    error = "exact: float64 to 1e-12 relative; float32 the same bits on every device"
    memory = "16 bytes per cell of the reachable map, on GPUs 32, less where that is over 4 GiB"
    precomputation = "empty rectangles, one pass over the map per quadrant"

    def prepare(self, backend: Backend, window: Window) -> Table:
        """See Caster.prepare."""
        rows, cols = window.obstacles.shape
        sectors = sectors_of(backend, rows, cols)
        flags = frozenset({f"SECTORS_{sectors}"} if sectors > 1 else ())
        return Table(empty_rectangles(backend, window.obstacles, sectors), 8 * sectors * (rows + 2) * (cols + 2), flags)

    def mend(self, backend: Backend, window: Window, table: Buffer, changed: Region) -> bool:
        """See Caster.mend."""
        empty_rectangles(backend, window.obstacles, sectors_of(backend, *window.obstacles.shape), table, changed)
        return True


@dataclass(frozen=True)
class Dda(Caster):
    """A walk from cell to cell (Amanatides and Woo 1987)."""

    name = "dda"
    exact = True
    error = "exact: the same bits as 'exact'"
    memory = "1 byte per cell of the reachable map"
    precomputation = "none"
    flag = "DDA"

    def prepare(self, backend: Backend, window: Window) -> Table:
        """See Caster.prepare."""
        return _padded_cells(backend, window)


@dataclass(frozen=True)
class Bresenham(Caster):
    """Bresenham's line from cell to cell, as nav2_amcl and Beluga cast."""

    name = "bresenham"
    error = "about a cell, from centre to centre; lines slip between walls that touch at a corner"
    memory = "1 byte per cell of the reachable map"
    precomputation = "none"
    flag = "BRESENHAM"

    def prepare(self, backend: Backend, window: Window) -> Table:
        """See Caster.prepare."""
        return _padded_cells(backend, window)


@dataclass(frozen=True)
class March(Caster):
    """Marching through the distance field.

    Args:
        tolerance: Least step [cells], 0.001 to 10: smaller is more exact and slower.
        rule: ``"safe"`` shortens steps by sqrt(2) cells, so that only the least step can pass an obstacle;
            ``"centre"`` takes the distance between cell centres as it is, as range_libc and f1tenth_gym do: faster, and
            corners are missed.

    Raises:
        TypeError, ValueError: a knob of the wrong kind, or out of range.
    """

    tolerance: float = 0.1
    rule: str = "safe"

    name = "march"
    error = "too long by at most tolerance, except where a ray clips less than that of a corner (rule 'safe')"
    memory = "4 bytes per cell of the reachable map"
    precomputation = "exact distance transform"
    knobs = "tolerance [cells], rule"
    flag = "MARCH"
    ring = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "tolerance", checks.real("tolerance", self.tolerance, low=1e-3, high=10))
        checks.choice("rule", self.rule, ("safe", "centre"))

    def prepare(self, backend: Backend, window: Window) -> Table:
        """See Caster.prepare."""
        # Walls outside are obstacles, too.
        ring = int(window.outside == "occupied")
        obstacles = np.pad(window.obstacles, ring, constant_values=True)
        squares = backend.download(squared_distances(backend, obstacles), np.empty(obstacles.shape, np.int32))
        squares = squares[ring:-ring, ring:-ring] if ring else squares
        distances = np.sqrt(np.where(squares == _NO_OBSTACLE, np.inf, squares)).astype(_SINGLE)
        return Table(backend.upload(distances), distances.nbytes)

    def scalars(self) -> tuple[int, float, float]:
        """See Caster.scalars."""
        return 0, math.sqrt(2) if self.rule == "safe" else 0.0, self.tolerance


@dataclass(frozen=True)
class Cddt(Caster):
    """Compressed directional distance transform (Walsh and Karaman 2018).

    Args:
        bins: Angle bins of a full turn, 4 to 4096: more are more exact, and take memory.
        pruned: Leave out obstacles that begin within another one of their line: less memory, and origins that lie free
            beside that other one may see through walls of a cell's thickness.

    Raises:
        TypeError, ValueError: a knob of the wrong kind, or out of range.
    """

    bins: int = 216
    pruned: bool = False

    name = "cddt"
    error = "across the ray, range * pi / bins + 1 cell; walls within that may be missed or hit"
    memory = "4 bytes per bin, line and obstacle"
    precomputation = "for each bin, obstacles at free cells are projected and sorted (on the host)"
    knobs = "bins, pruned"
    flag = "CDDT"
    whole = True
    ring = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "bins", checks.integer("bins", self.bins, low=4, high=4096))
        if not isinstance(self.pruned, bool):
            raise TypeError(f"pruned: must be True or False, got {checks.show(self.pruned)}")

    def prepare(self, backend: Backend, window: Window) -> Table:
        """See Caster.prepare."""
        outside = window.outside == "occupied"
        table = directional_table(window.obstacles, self.bins, pruned=self.pruned, outside=outside)
        return Table(backend.upload(table), table.nbytes)

    def scalars(self) -> tuple[int, float, float]:
        """See Caster.scalars."""
        return self.bins, 0.0, 0.0


@dataclass(frozen=True)
class Lookup(Caster):
    """Look-up table over cells and angle bins.

    Args:
        bins: Angle bins of a full turn, 4 to 4096: more are more exact, and take memory.
        file: A table that ``RayCaster.save_table`` wrote for this very map, range and number of bins; None makes it.

    Raises:
        TypeError, ValueError: a knob of the wrong kind, or out of range.
    """

    bins: int = 108
    file: str | Path | None = None

    name = "lookup"
    error = "position to half a cell, bearing to pi / bins: as wrong as the ranges differ there"
    memory = "2 bytes per bin and cell of the whole map"
    precomputation = "a ray per bin and cell by the exact caster"
    knobs = "bins"
    flag = "LOOKUP"
    whole = True
    ring = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "bins", checks.integer("bins", self.bins, low=4, high=4096))
        if self.file is not None:
            object.__setattr__(self, "file", checks.path("file", self.file))

    def prepare(self, backend: Backend, window: Window) -> Table:
        """See Caster.prepare."""
        rows, cols = window.obstacles.shape
        count = rows * cols * self.bins
        if self.file is not None:
            entries = read_lookup(Path(self.file), window.obstacles, window.limit, window.outside, self.bins)
            return Table(backend.upload(entries), 2 * count)
        table = backend.empty(count, _SHORT)
        rectangles = empty_rectangles(backend, window.obstacles, 1)
        turns = 2 * math.pi * np.arange(self.bins) / self.bins
        ray = backend.upload(np.stack([np.cos(turns), np.sin(turns)], axis=1).astype(_SINGLE))
        fill = backend.compile("fill_lookup", frozenset({"OUTSIDE_OCCUPIED"} if window.outside == "occupied" else ()))
        tile = max(_TILE[backend.info.kind] // (cols * self.bins), 1)
        for first in range(0, rows, tile):
            these = min(tile, rows - first)
            fill((self.bins, these * cols), rectangles, ray, table, rows, cols, self.bins, first, these, window.limit)
            backend.synchronize()
        return Table(table, 2 * count)

    def scalars(self) -> tuple[int, float, float]:
        """See Caster.scalars."""
        return self.bins, 0.0, 0.0


def _padded_cells(backend: Backend, window: Window) -> Table:
    """1 for occupied cells, in a ring of twos."""
    check_size(*window.obstacles.shape)
    cells = np.pad(window.obstacles.astype(_BYTE), 1, constant_values=2)
    return Table(backend.upload(cells), cells.nbytes)


CASTERS: dict[str, type[Caster]] = {kind.name: kind for kind in (Exact, Dda, March, Bresenham, Cddt, Lookup)}


def choose(argument: str, value: object) -> Caster:
    """A caster by its name, or itself.

    Raises:
        TypeError: neither a name nor a caster.
        ValueError: a name of none.
    """
    if isinstance(value, Caster):
        return value
    return CASTERS[checks.choice(argument, value, tuple(CASTERS))]()
