"""A table of the reachable window of a map, held on a device and made again when the cloud leaves the window."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gpusense.backends import Backend
from gpusense.backends.base import Buffer
from gpusense.interface.plan import Omission, share
from gpusense.world import windows
from gpusense.world.frames import Mount
from gpusense.world.grid import OccupancyGrid
from gpusense.world.windows import Corners, Window


class TableMemoryError(MemoryError):
    """Error of a device that cannot hold a map's table; smaller pieces of a cloud would not help."""


class ReachableMap:
    """A map and the table of its reachable window on a device.

    Args:
        backend: The device.
        grid: The map.
        unknown: Whether unknown cells are ``"free"`` or ``"occupied"``.
        mount: The sensor's pose on the robot [m, m, rad].
        reach: Longest distance from a sensor that matters [cells].
        prepare: Function that makes the table of a window from its (rows, cols) obstacles.
        crop: Whether to prepare the reachable window only; False prepares the whole map.
        refresh: Function that updates a table in place after obstacles changed in a part of its window, and returns
            whether it did; after False the table is made again.

    Attributes:
        obstacles: (H, W) bool, of the whole map.
        window: The table's window; None without a table.
        preparations: Number of tables made.
        version: Number that grows whenever the map changes or the table is made again.
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
    ) -> None:
        self._backend, self._grid, self._mount, self._reach, self._crop = backend, grid, mount, reach, crop
        self._prepare, self._refresh, self._unknown, self._shared = prepare, refresh, unknown, True
        self.obstacles = grid.obstacles("occupied" if unknown == "occupied" else "free")
        self._table: Buffer = None
        self.window: Window | None = None
        self.preparations = 0
        self.version = 0

    def ensure(self, corners: Corners | None) -> tuple[Buffer, Window]:
        """Return the table and its window; make both again if a sensor can reach beyond the window.

        Args:
            corners: Poses whose box holds all poses; None for poses anywhere.

        Raises:
            TableMemoryError: The device cannot hold the table.
        """
        if self._crop and corners is not None:
            window = windows.choose(self._grid, self.window, corners, self._mount, self._reach)
        else:
            window = windows.whole(self._grid)
        if window != self.window or self._table is None:
            self._table, self.window = None, None
            try:
                self._table = self._prepare(self._backend, window.cut(self.obstacles))
            except MemoryError as error:
                raise TableMemoryError(*error.args) from error
            self.window = window
            self.preparations += 1
            self.version += 1
        assert self.window is not None
        return self._table, self.window

    def update(self, cells: object, place: object) -> OccupancyGrid:
        """Replace cells of the map; update the table now, or drop it so that the next call makes it again.

        Args:
            cells: (h, w) occupancies.
            place: (row, col) of the cell that ``cells[0, 0]`` replaces.

        Returns:
            The new map.

        Raises:
            TypeError, ValueError: The cells or the place do not fit the grid; nothing has changed.
        """
        grid = self._grid.with_cells(cells, place)  # type: ignore[arg-type]
        row, col = np.asarray(place).tolist()
        patch = OccupancyGrid(cells, occupied_threshold=grid.occupied_threshold)  # type: ignore[arg-type]
        obstacles = patch.obstacles("occupied" if self._unknown == "occupied" else "free")
        self._grid, part = grid, Window(row, col, *patch.shape)
        self.version += 1
        changed = windows.box(part.cut(self.obstacles) != obstacles)
        if changed is None:
            return grid
        if self._shared:
            # The array belongs to the grid and is read-only.
            self.obstacles, self._shared = self.obstacles.copy(), False
        part.cut(self.obstacles)[...] = obstacles
        window = self.window
        if window is None or (near := window.shared(changed.moved(row, col))) is None or self._table is None:
            return grid
        # The table is dropped first, so that an error leaves no outdated table behind.
        table, self._table = self._table, None
        try:
            current = self._refresh(
                self._backend, window.cut(self.obstacles), table, near.moved(-window.row, -window.col)
            )
        except MemoryError:
            current = False
        self._table = table if current else None
        return grid

    def omission(self, bytes_per_cell: float) -> Omission | None:
        """Describe the part of the map outside the window; None if there is none, or no cloud has come yet."""
        everything = windows.whole(self._grid)
        if self.window is None or self.window == everything:
            return None
        left = everything.cells - self.window.cells
        return Omission(
            "far map",
            f"no particle reaches beyond {self.window.rows} x {self.window.cols} of {everything.rows} x "
            f"{everything.cols} cells",
            f"{share(left, everything.cells)} of the preparation and {left * bytes_per_cell / 1e6:.0f} MB",
        )
