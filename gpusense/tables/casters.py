"""Define the casters: methods of computing expected ranges, with error, memory and knobs.

``RayCaster(method=...)`` and ``BeamModel(caster=...)`` take a caster, or a name for default knobs.
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
from gpusense.interface import structs
from gpusense.interface.casters import ENTRIES, CasterEntry
from gpusense.tables.directional import directional_table
from gpusense.tables.distances import NO_OBSTACLE, chebyshev_distances, check_size, squared_distances
from gpusense.tables.lookup_files import read_lookup
from gpusense.tables.rectangles import Planes, empty_rectangles, planes_of
from gpusense.world import windows
from gpusense.world.windows import Window


@dataclass(frozen=True)
class CasterInput:
    """Window of a map, the input of a caster's table."""

    obstacles: np.ndarray  # (rows, cols) bool
    limit: float  # longest range [cells]
    outside: str  # ``"free"`` or ``"occupied"``: state of space outside the grid


@dataclass(frozen=True)
class Table:
    """Table of a caster on a device."""

    buffer: Buffer  # the table
    size: int  # its size [bytes]
    flags: frozenset[str] = frozenset()  # flags of the kernels that read it


class Caster(ABC):
    """Method of computing expected ranges.

    Attributes:
        name: Name of the caster in the registry; it selects default knobs.
        exact: True for exact ranges.
        error: ``"exact"``, or the bound on its error.
        memory: Memory on the device, in words.
        precomputation: Work on the map before the first ray, in words.
        knobs: Parameters that trade error for time, in words.
        whole: True if the table needs the whole map at once.
        ring: True if a ring of cells in the table represents space outside the grid.
        stops: True if a ray may end before the longest range.
    """

    name: ClassVar[str]
    exact: ClassVar[bool] = False
    error: ClassVar[str]
    memory: ClassVar[str]
    precomputation: ClassVar[str]
    knobs: ClassVar[str] = "none"
    whole: ClassVar[bool] = False
    ring: ClassVar[bool] = True
    stops: ClassVar[bool] = True

    @property
    def beyond(self) -> int:
        """Number of cells beyond the longest range that affect a result."""
        return 0

    @property
    def entry(self) -> CasterEntry:
        """The caster in the registry."""
        return ENTRIES[self.name]

    @abstractmethod
    def prepare(self, backend: Backend, inputs: CasterInput) -> Table:
        """Make the table of a window on a device."""

    def refresh(self, backend: Backend, inputs: CasterInput, table: Buffer, changed: Window) -> bool:
        """Update the table in place after obstacles in ``changed`` changed; return False if it must be made again."""
        return False

    def struct(self) -> structs.Caster:
        """Return the knobs for kernels."""
        return structs.Caster(0, 0.0, 0.0)


__all__ = ["CASTERS", "Bresenham", "Caster", "Cddt", "Dda", "Exact", "Lookup", "March"]

_BYTE, _SHORT, _SINGLE = (np.dtype(name) for name in (np.uint8, np.uint16, np.float32))
# Rays per launch when filling a look-up table, for launches of about a second.
_TILE = {"cpu": 1 << 22, "gpu": 1 << 30}
# Entry of a ring outside of which a line meets nothing; the kernel file ``bresenham`` has the same number.
_EDGE = 255
# Flags of other programs' lines.
_LINES = {"amcl": "AMCL_LINES", "beluga": "BELUGA_LINES"}


@dataclass(frozen=True)
class Exact(Caster):
    """Traversal that crosses an empty rectangle per step."""

    name = "exact"
    exact = True
    error = "exact: float64 to 1e-12 relative; float32 the same bits on every device"
    memory = "16 bytes per cell of the reachable map, on GPUs 32 up to 2^25 cells, 8 where that is over 4 GiB"
    precomputation = "empty rectangles, one pass over the map per quadrant"

    def prepare(self, backend: Backend, inputs: CasterInput) -> Table:
        planes = planes_of(backend, *inputs.obstacles.shape)
        table = empty_rectangles(backend, inputs.obstacles, planes)
        return Table(table, 2 * planes.entries(*inputs.obstacles.shape), planes.flags)

    def refresh(self, backend: Backend, inputs: CasterInput, table: Buffer, changed: windows.Window) -> bool:
        empty_rectangles(backend, inputs.obstacles, planes_of(backend, *inputs.obstacles.shape), table, changed)
        return True


@dataclass(frozen=True)
class Dda(Caster):
    """Traversal from cell to cell (Amanatides and Woo 1987)."""

    name = "dda"
    exact = True
    error = "exact: the same bits as 'exact'"
    memory = "1 byte per cell of the reachable map"
    precomputation = "none"

    def prepare(self, backend: Backend, inputs: CasterInput) -> Table:
        check_size(*inputs.obstacles.shape)
        cells = np.pad(inputs.obstacles.astype(_BYTE), 1, constant_values=2)
        return Table(backend.upload(cells), cells.nbytes)


@dataclass(frozen=True)
class Bresenham(Caster):
    """Bresenham's line, which leaps by the Chebyshev distance to the next obstacle.

    Args:
        lines: None; ``"amcl"`` for lines that extend one cell beyond the ray's end and may exceed range_max; or
            ``"beluga"`` for lines that go straight midway between two cells, and meet nothing from outside the grid.
    """

    lines: str | None = None

    name = "bresenham"
    stops = False
    error = "about a cell, from centre to centre; lines slip between walls that touch at a corner"
    memory = "1 byte per cell of the reachable map"
    precomputation = "Chebyshev distances (on the host)"
    knobs = "lines (None, 'amcl', 'beluga')"

    def __post_init__(self) -> None:
        if self.lines is not None:
            checks.choice("lines", self.lines, tuple(_LINES))

    def __repr__(self) -> str:
        return "Bresenham()" if self.lines is None else f"Bresenham(lines={self.lines!r})"

    @property
    def beyond(self) -> int:
        return 2 if self.lines == "amcl" else 0

    def prepare(self, backend: Backend, inputs: CasterInput) -> Table:
        check_size(*inputs.obstacles.shape)
        leaps = chebyshev_distances(np.pad(inputs.obstacles, 1, constant_values=True), _EDGE - 1)
        if inputs.outside == "free":
            leaps[[0, -1]] = leaps[:, [0, -1]] = _EDGE
        flags = frozenset() if self.lines is None else frozenset({_LINES[self.lines]})
        return Table(backend.upload(leaps), leaps.nbytes, flags)


@dataclass(frozen=True)
class March(Caster):
    """Ray marching through the distance field.

    Args:
        tolerance: Least step [cells], 0.001 to 10: smaller steps are more exact and slower.
        rule: ``"safe"`` shortens steps by sqrt(2) cells, so that only the least step can pass an obstacle.
            ``"centre"`` steps by the distance between cell centres, like range_libc and f1tenth_gym: faster, but misses
            corners.
    """

    tolerance: float = 0.1
    rule: str = "safe"

    name = "march"
    error = "too long by at most tolerance, except where a ray clips less than that of a corner (rule 'safe')"
    memory = "4 bytes per cell of the reachable map"
    precomputation = "exact distance transform"
    knobs = "tolerance [cells], rule"
    ring = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "tolerance", checks.real("tolerance", self.tolerance, low=1e-3, high=10))
        checks.choice("rule", self.rule, ("safe", "centre"))

    def prepare(self, backend: Backend, inputs: CasterInput) -> Table:
        # Walls outside the grid are obstacles.
        ring = int(inputs.outside == "occupied")
        obstacles = np.pad(inputs.obstacles, ring, constant_values=True)
        squares = backend.download(squared_distances(backend, obstacles), np.empty(obstacles.shape, np.int32))
        squares = squares[ring:-ring, ring:-ring] if ring else squares
        distances = np.sqrt(np.where(squares == NO_OBSTACLE, np.inf, squares)).astype(_SINGLE)
        return Table(backend.upload(distances), distances.nbytes)

    def struct(self) -> structs.Caster:
        return structs.Caster(0, math.sqrt(2) if self.rule == "safe" else 0.0, self.tolerance)


@dataclass(frozen=True)
class Cddt(Caster):
    """Compressed directional distance transform (Walsh and Karaman 2018).

    Args:
        bins: Angle bins of a full turn, 4 to 4096: more bins are more exact and take more memory.
        pruned: Whether to omit obstacles that begin inside another obstacle of their line, for a smaller table. Rays
            from free origins next to the other obstacle may then pass through walls of one cell's thickness.
    """

    bins: int = 216
    pruned: bool = False

    name = "cddt"
    error = "across the ray, range * pi / bins + 1 cell; walls within that may be missed or hit"
    memory = "4 bytes per bin, line and obstacle"
    precomputation = "for each bin, obstacles at free cells are projected and sorted (on the host)"
    knobs = "bins, pruned"
    whole = True
    ring = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "bins", checks.integer("bins", self.bins, low=4, high=4096))
        checks.boolean("pruned", self.pruned)

    def prepare(self, backend: Backend, inputs: CasterInput) -> Table:
        outside = inputs.outside == "occupied"
        table = directional_table(inputs.obstacles, self.bins, pruned=self.pruned, outside=outside)
        return Table(backend.upload(table), table.nbytes)

    def struct(self) -> structs.Caster:
        return structs.Caster(self.bins, 0.0, 0.0)


@dataclass(frozen=True)
class Lookup(Caster):
    """Look-up table over cells and angle bins.

    Args:
        bins: Angle bins of a full turn, 4 to 4096: more bins are more exact and take more memory.
        file: Table from ``RayCaster.save_table`` for the same map, range and number of bins; None computes it.
    """

    bins: int = 108
    file: str | Path | None = None

    name = "lookup"
    stops = False
    error = "position to half a cell, bearing to pi / bins: as wrong as the ranges differ there"
    memory = "2 bytes per bin and cell of the whole map"
    precomputation = "a ray per bin and cell by the exact caster"
    knobs = "bins"
    whole = True
    ring = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "bins", checks.integer("bins", self.bins, low=4, high=4096))
        if self.file is not None:
            object.__setattr__(self, "file", checks.path("file", self.file))

    def prepare(self, backend: Backend, inputs: CasterInput) -> Table:
        size = 2 * inputs.obstacles.size * self.bins
        if self.file is not None:
            entries = read_lookup(Path(self.file), inputs.obstacles, inputs.limit, inputs.outside, self.bins)
            return Table(backend.upload(entries), size)
        return Table(self._fill(backend, inputs), size)

    def _fill(self, backend: Backend, inputs: CasterInput) -> Buffer:
        """Cast a ray per bin and cell, a strip of rows per launch."""
        rows, cols = inputs.obstacles.shape
        table = backend.empty(rows * cols * self.bins, _SHORT)
        rectangles = empty_rectangles(backend, inputs.obstacles, Planes(1))
        turns = 2 * math.pi * np.arange(self.bins) / self.bins
        ray = backend.upload(np.stack([np.cos(turns), np.sin(turns)], axis=1).astype(_SINGLE))
        fill = backend.compile("fill_lookup", frozenset({"OUTSIDE_OCCUPIED"} if inputs.outside == "occupied" else ()))
        window = structs.Window(0, 0, rows, cols)
        tile = max(_TILE[backend.info.kind] // (cols * self.bins), 1)
        for first in range(0, rows, tile):
            strip = min(tile, rows - first)
            fill((self.bins, strip * cols), rectangles, ray, table, window, self.bins, first, strip, inputs.limit)
            backend.synchronize()
        return table

    def struct(self) -> structs.Caster:
        return structs.Caster(self.bins, 0.0, 0.0)


_ALL: tuple[type[Caster], ...] = (Exact, Dda, March, Bresenham, Cddt, Lookup)
CASTERS = {caster.name: caster for caster in _ALL}


def choose(argument: str, value: object, lines: str | None = None) -> Caster:
    """Return a caster by name, or a caster unchanged; Bresenham takes another program's ``lines``."""
    if isinstance(value, Caster):
        return value
    caster = CASTERS[checks.choice(argument, value, tuple(CASTERS))]
    return Bresenham(lines) if caster is Bresenham else caster()
