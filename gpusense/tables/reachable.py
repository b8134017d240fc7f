"""Keep a table of the reachable window of a map on a device, and rebuild it when the cloud leaves the window."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from gpusense.backends import Backend
from gpusense.backends.base import Buffer
from gpusense.interface.plan import Omission, share
from gpusense.world import windows
from gpusense.world.frames import Mount, plain_cells
from gpusense.world.grid import OccupancyGrid
from gpusense.world.windows import Corners, Frame, Window

ObstaclesOf = Callable[[OccupancyGrid, str], np.ndarray]
"""Function that returns an (H, W) mask from a grid and the state of unknown cells."""


def obstacles_of(grid: OccupancyGrid, unknown: str) -> np.ndarray:
    """Return the (H, W) mask of the cells that stop a beam; do not write to it."""
    return grid.obstacles("occupied" if unknown == "occupied" else "free")


_NOWHERE = Window(0, 0, 0, 0)


class TableMemoryError(MemoryError):
    """A device cannot hold a map's table, for any size of the cloud."""


@dataclass(frozen=True)
class MapState:
    """Map and table; a single assignment replaces both, so that no interrupt can separate them."""

    grid: OccupancyGrid  # the map
    mount: Mount  # the sensor's pose on the robot [m, m, rad]
    obstacles: np.ndarray | None = None  # (H, W) mask of the map; None if an interrupted update may have written to it
    shared: bool = True  # true if the array of obstacles belongs to the grid and is read-only
    table: Buffer = None  # the table, or None
    window: Window = _NOWHERE  # the table's window; empty without a table
    preparations: int = 0  # number of tables made
    version: int = 0  # counter of changes

    @functools.cached_property
    def frame(self) -> Frame:
        """The frame of poses in the table's window."""
        return Frame(self.window, plain_cells(self.grid), self.mount)


class ReachableMap:
    """A map and the table of its reachable window on a device.

    An interrupt or an error leaves the map as before or as after the call, never in between.

    ``reach``: longest relevant distance from a sensor [cells]; ``prepare``: makes the table of a window from its (rows,
    cols) obstacles; ``crop``: whether to prepare the reachable window only; ``refresh``: updates a table in place after
    obstacles changed in a part of its window, and returns whether it could; ``neighbors``: radius of the neighbourhood
    that determines a cell's state in the mask [cells].
    """

    def __init__(
        self,
        backend: Backend,
        grid: OccupancyGrid,
        unknown: str,
        mount: Mount,
        reach: float,
        prepare: Callable[[Backend, np.ndarray], Buffer],
        crop: bool,
        refresh: Callable[[Backend, np.ndarray, Buffer, Window], bool],
        *,
        obstacles_of: ObstaclesOf = obstacles_of,
        neighbors: int = 0,
    ) -> None:
        self._backend, self._reach, self._crop = backend, reach, crop
        self._prepare, self._refresh, self._unknown = prepare, refresh, unknown
        self._mask_of, self._neighbors = obstacles_of, neighbors
        self._whole = windows.whole(grid)
        self._state = MapState(grid, mount, self._obstacles_of(grid))

    @property
    def grid(self) -> OccupancyGrid:
        """The current map."""
        return self._state.grid

    @property
    def obstacles(self) -> np.ndarray:
        """(H, W) mask, of the whole map."""
        obstacles = self._state.obstacles
        if obstacles is None:
            obstacles = self._obstacles_of(self._state.grid)
            self._state = replace(self._state, obstacles=obstacles, shared=True)
        return obstacles

    @property
    def window(self) -> Window | None:
        """The table's window; None before the first table."""
        return self._state.window if self._state.window.cells else None

    @property
    def preparations(self) -> int:
        """Number of tables made."""
        return self._state.preparations

    @property
    def version(self) -> int:
        """Counter of changes to the map, and of dropped or rebuilt tables."""
        return self._state.version

    def drop(self) -> None:
        """Drop the table; the next call rebuilds it."""
        self._state = replace(self._state, table=None, version=self.version + 1)

    def ensure(self, corners: Corners | None) -> MapState:
        """Return the map with its table, rebuilt if a sensor can reach beyond its window."""
        if self._state.window is self._whole and self._state.table is not None:
            return self._state
        if self._crop and corners is not None:
            window = windows.choose(self.grid, self.window, corners, self._state.mount, self._reach)
        else:
            window = self._whole
        window = self._whole if window == self._whole else window
        if window != self.window or self._state.table is None:
            # The device may not have room for both tables.
            self._state = replace(self._state, table=None, window=_NOWHERE)
            try:
                table = self._prepare(self._backend, window.cut(self.obstacles))
            except MemoryError as error:
                raise TableMemoryError(*error.args) from error
            count, version = self.preparations + 1, self.version + 1
            self._state = replace(self._state, table=table, window=window, preparations=count, version=version)
        return self._state

    def update(self, cells: object, place: object) -> OccupancyGrid:
        """Replace cells of the map from ``place`` on, and return it; update the table now, or drop it."""
        grid = self.grid.with_cells(cells, place)  # type: ignore[arg-type]
        row, col = np.asarray(place).tolist()
        patched, part = self._patched(grid, Window(row, col, *np.asarray(cells).shape))
        changed = windows.box(part.cut(self.obstacles) != patched)
        if changed is None:
            self._state = replace(self._state, grid=grid, version=self.version + 1)
            return grid
        obstacles = self.obstacles.copy() if self._state.shared else self.obstacles
        table = self._state.table
        # Drop the old map's obstacles and table first: both are written in place, and an interrupt would leave them
        # half written.
        self._state = replace(self._state, obstacles=None, table=None, version=self.version + 1)
        part.cut(obstacles)[...] = patched
        table = self._refreshed(table, obstacles, changed.moved(part.row, part.col))
        self._state = replace(self._state, grid=grid, obstacles=obstacles, shared=False, table=table)
        return grid

    def _refreshed(self, table: Buffer, obstacles: np.ndarray, changed: Window) -> Buffer:
        """Return a table after obstacles changed in a part of the map; None to rebuild it."""
        window = self.window
        if window is None or table is None or (near := window.shared(changed)) is None:
            return table
        try:
            current = self._refresh(self._backend, window.cut(obstacles), table, near.moved(-window.row, -window.col))
        except MemoryError:
            current = False
        return table if current else None

    def _patched(self, grid: OccupancyGrid, changed: Window) -> tuple[np.ndarray, Window]:
        """Return the mask of all cells that depend on cells of a window, and the window of these cells."""
        part = changed.grown(self._neighbors, grid.shape)
        around = part.grown(self._neighbors, grid.shape)
        patch = OccupancyGrid(around.cut(grid.cells), occupied_threshold=grid.occupied_threshold)
        return part.moved(-around.row, -around.col).cut(self._obstacles_of(patch)), part

    def _obstacles_of(self, grid: OccupancyGrid) -> np.ndarray:
        return self._mask_of(grid, self._unknown)

    def omission(self, bytes_per_cell: float) -> Omission | None:
        """Describe the part of the map outside the window; None if it is empty or before the first cloud."""
        everything = windows.whole(self.grid)
        if self.window is None or self.window == everything:
            return None
        left = everything.cells - self.window.cells
        return Omission(
            "far map",
            f"no particle reaches beyond {self.window.rows} x {self.window.cols} of {everything.rows} x "
            f"{everything.cols} cells",
            f"{share(left, everything.cells)} of the preparation and {left * bytes_per_cell / 1e6:.0f} MB",
        )
