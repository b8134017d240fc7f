"""A table made of the reachable part of a map, kept on the device and refreshed when the cloud leaves it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gpusense.backends import Backend
from gpusense.backends.base import Buffer
from gpusense.interface.plan import Omission, share
from gpusense.world import windows
from gpusense.world.frames import Mount
from gpusense.world.grid import OccupancyGrid
from gpusense.world.windows import Corners, Region


class TableMemoryError(MemoryError):
    """The device cannot hold a map's table: fewer particles in a piece would not help."""


class ReachableMap:
    """Owns a prepared table of the map.

    Args:
        grid: The map.
        unknown: Whether unknown cells are ``"free"`` or ``"occupied"``.
        mount: The sensor's pose on the robot.
        reach: Longest distance in cells from a sensor that matters.
        prepare: Makes the table of a window from its (rows, cols) obstacles.
        crop: False prepares the whole map at once.
        mend: Makes a table follow obstacles that changed within a part of its window, and says whether it did; False
            where the table is to be made anew.
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
        mend: Callable[[Backend, np.ndarray, Buffer, Region], bool],
    ) -> None:
        self._backend, self._grid, self._mount, self._reach, self._crop = backend, grid, mount, reach, crop
        self._prepare, self._mend, self._unknown, self._shared = prepare, mend, unknown, True
        self.obstacles = grid.obstacles("occupied" if unknown == "occupied" else "free")
        self._table: Buffer = None
        self.region: Region | None = None
        self.preparations = 0
        # Grows whenever the map changes or the table is made anew.
        self.version = 0

    def ensure(self, corners: Corners | None) -> tuple[Buffer, Region]:
        """The table and its window, made anew if poses within these corners can reach beyond it; None may be anywhere.

        Raises:
            TableMemoryError: the device cannot hold the table.
        """
        if self._crop and corners is not None:
            wanted = windows.choose(self._grid, self.region, corners, self._mount, self._reach)
        else:
            wanted = windows.whole(self._grid)
        if wanted != self.region or self._table is None:
            self._table, self.region = None, None
            try:
                self._table = self._prepare(self._backend, wanted.cut(self.obstacles))
            except MemoryError as error:
                raise TableMemoryError(*error.args) from error
            self.region = wanted
            self.preparations += 1
            self.version += 1
        assert self.region is not None
        return self._table, self.region

    def update(self, cells: object, place: object) -> OccupancyGrid:
        """Replace cells of the map from (row, col) on; the table follows, now or, where it is made anew, when needed.

        Returns:
            The map as it is now.

        Raises:
            TypeError, ValueError: cells or a place that no grid can have; nothing has changed then.
        """
        grid = self._grid.with_cells(cells, place)  # type: ignore[arg-type]
        row, col = np.asarray(place).tolist()
        patch = OccupancyGrid(cells, occupied_threshold=grid.occupied_threshold)  # type: ignore[arg-type]
        obstacles = patch.obstacles("occupied" if self._unknown == "occupied" else "free")
        self._grid, part = grid, Region(row, col, *patch.shape)
        self.version += 1
        changed = windows.box(part.cut(self.obstacles) != obstacles)
        if changed is None:
            return grid
        if self._shared:
            # The grid's own array, and read-only.
            self.obstacles, self._shared = self.obstacles.copy(), False
        part.cut(self.obstacles)[...] = obstacles
        window = self.region
        if window is None or (near := window.shared(changed.moved(row, col))) is None or self._table is None:
            return grid
        # Should the device refuse, nothing is left that could be taken for the table of this map.
        table, self._table = self._table, None
        try:
            mended = self._mend(self._backend, window.cut(self.obstacles), table, near.moved(-window.row, -window.col))
        except MemoryError:
            mended = False
        self._table = table if mended else None
        return grid

    def omission(self, bytes_per_cell: float) -> Omission | None:
        """What cropping leaves out, once a cloud has been seen."""
        everything = windows.whole(self._grid)
        if self.region is None or self.region == everything:
            return None
        left = everything.cells - self.region.cells
        return Omission(
            "far map",
            f"no particle reaches beyond {self.region.rows} x {self.region.cols} of {everything.rows} x "
            f"{everything.cols} cells",
            f"{share(left, everything.cells)} of the preparation and {left * bytes_per_cell / 1e6:.0f} MB",
        )
