"""Worlds in place of a map in models: their table, and checks of a model's options."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from gpusense._util import checks
from gpusense.backends import Backend
from gpusense.backends.base import Buffer
from gpusense.tables.world_index import WorldIndex
from gpusense.tables.worlds import Worlds
from gpusense.world.frames import Mount, plain_cells
from gpusense.world.grid import OccupancyGrid
from gpusense.world.windows import Frame, Window


class WorldMap:
    """The table of all worlds for a model, in place of a map's reachable window, here of the largest world's size."""

    def __init__(self, worlds: Worlds, mount: Mount, make: Callable[[], Buffer]) -> None:
        self.grid, self._make, self.version, self.preparations = worlds, make, 0, 0
        self.table: Buffer = None
        self.window = Window(0, 0, *worlds.shape)
        self.frame = Frame(self.window, plain_cells(worlds), mount)
        worlds.maps.add(self)

    def ensure(self, corners: object) -> WorldMap:
        """Return the map with its table."""
        if self.table is None:
            self.table = self._make()
            self.preparations, self.version = 1, self.version + 1
        return self

    def drop(self) -> None:
        """Keep the table: it belongs to the worlds."""

    def omission(self, bytes_per_cell: float) -> None:
        """Return None: worlds are prepared as a whole."""

    def update(self, cells: object, place: object) -> OccupancyGrid:
        """Refuse a change of cells."""
        raise ValueError("grid: must be a single map for update_map, got Worlds; worlds.replace(index, cells) does it")


def index_of(grid: OccupancyGrid | Worlds, world: Any, ignore: Any, count: int, backend: Backend) -> WorldIndex | None:
    """Return the worlds of poses; None for a single map."""
    if isinstance(grid, Worlds):
        return WorldIndex(grid, world, ignore, count, backend)
    for name, value in (("world", world), ("ignore", ignore)):
        if value is not None:
            raise ValueError(f"{name}: must be None for a model of a single map, got {checks.show(value)}")
    return None


def check_worlds(worlds: Worlds, backend: Backend) -> Worlds:
    """Return worlds after a check of their device."""
    if worlds.backend is not backend:
        here, there = backend.info.selection, worlds.device.selection
        raise ValueError(f"grid: must be Worlds on the model's device {here!r}, got backend={there!r}; "
                         f"pass backend={there!r}, or make the worlds on {here!r}")  # fmt: skip
    return worlds


def check_no_worlds(grid: object, compat: object) -> None:
    """Refuse peers' formulas in worlds."""
    if isinstance(grid, Worlds) and compat is not None:
        raise ValueError(f"compat: must be None in Worlds, got {checks.show(compat)}")


def check_one_map(name: str, model: Any) -> None:
    """Refuse a model of worlds where a single map is needed."""
    if isinstance(getattr(model, "grid", None), Worlds):
        raise ValueError(f"{name}: must be of a single map, got one of {model.grid!r}; take worlds.grid(index)")
