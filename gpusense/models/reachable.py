"""A table made of the reachable part of a map, kept on the device and refreshed when the cloud leaves it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from gpusense import region
from gpusense.backends import Backend
from gpusense.backends.base import Buffer
from gpusense.frames import Mount
from gpusense.grid import OccupancyGrid
from gpusense.plan import Omission, share
from gpusense.region import Region


class ReachableMap:
    """Owns a prepared table of the map.

    Args:
        grid: The map.
        unknown: Whether unknown cells are ``"free"`` or ``"occupied"``.
        mount: The sensor's pose on the robot.
        reach: Longest distance in cells from a sensor that matters.
        prepare: Makes the table of a window from its (rows, cols) obstacles.
        crop: False prepares the whole map at once.
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
    ) -> None:
        self._backend, self._grid, self._mount, self._reach, self._crop = backend, grid, mount, reach, crop
        self._prepare = prepare
        self.obstacles = grid.obstacles("occupied" if unknown == "occupied" else "free")
        self._table: Buffer = None
        self.region: Region | None = None
        self.preparations = 0

    def ensure(self, poses: np.ndarray) -> tuple[Buffer, Region]:
        """The table and its window, made anew if these (N, 3) poses, N > 0, can reach beyond it."""
        if self._crop:
            wanted = region.choose(self._grid, self.region, poses, self._mount, self._reach)
        else:
            wanted = region.whole(self._grid)
        if wanted != self.region:
            self._table, self.region = None, None
            self._table = self._prepare(self._backend, wanted.cut(self.obstacles))
            self.region = wanted
            self.preparations += 1
        assert self.region is not None
        return self._table, self.region

    def omission(self, bytes_per_cell: float) -> Omission | None:
        """What cropping leaves out, once a cloud has been seen."""
        everything = region.whole(self._grid)
        if self.region is None or self.region == everything:
            return None
        left = everything.cells - self.region.cells
        return Omission(
            "far map",
            f"no particle reaches beyond {self.region.rows} x {self.region.cols} of {everything.rows} x "
            f"{everything.cols} cells",
            f"{share(left, everything.cells)} of the preparation and {left * bytes_per_cell / 1e6:.0f} MB",
        )
