"""The map: an occupancy grid with its place in the world."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpusense._util import checks


class OccupancyGrid:
    """An immutable occupancy grid, as in ``nav_msgs/OccupancyGrid``.

    ``cells[row, col]`` is the half-open square ``[col, col + 1) x [row, row + 1)`` in cell units, times
    ``resolution``, turned by the origin's yaw and moved to the origin; ``cells[0, 0]`` touches the origin
    (REP-103 axes: x along the columns, y along the rows, yaw counter-clockwise).

    Args:
        cells: (H, W) integers, at least one: occupancy in per cent, 0 to 100, or -1 for unknown. Copied.
        resolution: the side of a cell [m], > 0.
        origin: (x, y, yaw) of the outer corner of ``cells[0, 0]`` in the world [m, m, rad].
        occupied_threshold: a cell of at least this many per cent is occupied, 1 to 100. The default is
            map_server's ``occupied_thresh`` of 0.65.

    Raises:
        TypeError: an argument is not of the kind described, such as cells of dtype float or bool.
        ValueError: a shape or a value breaks the rules above.
    """

    __slots__ = ("_cells", "_occupied", "_occupied_threshold", "_origin", "_resolution")

    def __init__(
        self,
        cells: ArrayLike,
        resolution: float = 0.05,
        origin: ArrayLike = (0.0, 0.0, 0.0),
        *,
        occupied_threshold: int = 65,
    ) -> None:
        self._cells = _own_cells(cells)
        self._resolution = checks.real("resolution", resolution, above=0)
        x, y, yaw = checks.array("origin", origin, (3,)).tolist()
        self._origin: tuple[float, float, float] = (x, y, yaw)
        self._occupied_threshold = checks.integer("occupied_threshold", occupied_threshold, low=1, high=100)
        self._occupied: NDArray[np.bool] | None = None

    @property
    def cells(self) -> NDArray[np.int8]:
        """(H, W) occupancy in per cent, -1 where unknown; read-only."""
        return self._cells

    @property
    def resolution(self) -> float:
        """The side of a cell [m]."""
        return self._resolution

    @property
    def origin(self) -> tuple[float, float, float]:
        """(x, y, yaw) of the outer corner of ``cells[0, 0]`` in the world [m, m, rad]."""
        return self._origin

    @property
    def occupied_threshold(self) -> int:
        """The least occupancy of an occupied cell [per cent]."""
        return self._occupied_threshold

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W), the numbers of rows and columns."""
        rows, cols = self._cells.shape
        return rows, cols

    @property
    def width(self) -> float:
        """The extent along the columns, the grid's own x axis [m]."""
        return self.shape[1] * self._resolution

    @property
    def height(self) -> float:
        """The extent along the rows, the grid's own y axis [m]."""
        return self.shape[0] * self._resolution

    @property
    def occupied(self) -> NDArray[np.bool]:
        """(H, W), where the occupancy is at least ``occupied_threshold``; computed once, read-only."""
        if self._occupied is None:
            occupied = self._cells >= self._occupied_threshold
            occupied.setflags(write=False)
            self._occupied = occupied
        return self._occupied

    @property
    def unknown(self) -> NDArray[np.bool]:
        """(H, W), where nothing is known."""
        return self._cells < 0

    @property
    def free(self) -> NDArray[np.bool]:
        """(H, W), where the cell is neither occupied nor unknown."""
        return (self._cells >= 0) & (self._cells < self._occupied_threshold)

    def obstacles(self, unknown: Literal["free", "occupied"] = "free") -> NDArray[np.bool]:
        """What stops a beam.

        Args:
            unknown: whether an unknown cell counts as ``"free"`` or as ``"occupied"``.

        Returns:
            (H, W) bool; read it, do not write to it.

        Raises:
            TypeError: ``unknown`` is not a string.
            ValueError: ``unknown`` is neither of the two.
        """
        checks.choice("unknown", unknown, ("free", "occupied"))
        if unknown == "free":
            return self.occupied
        # One pass: as a byte, -1 is above every threshold.
        return self._cells.view(np.uint8) >= self._occupied_threshold

    def with_cells(self, cells: ArrayLike, region: ArrayLike) -> OccupancyGrid:
        """A grid of which some cells are others.

        Args:
            cells: (h, w) integers, at least one: occupancy in per cent, 0 to 100, or -1 for unknown.
            region: (row, col) of the cell that ``cells[0, 0]`` replaces. All must lie in the grid.

        Raises:
            TypeError: the cells or the region are not integers.
            ValueError: a shape or a value breaks the rules above.
        """
        patch = _own_cells(cells)
        row, col = checks.array("region", region, (2,), dtype=np.int64).tolist()
        rows, cols = patch.shape
        if not (0 <= row <= self.shape[0] - rows and 0 <= col <= self.shape[1] - cols):
            size = f"{rows} x {cols} cells within {self.shape[0]} x {self.shape[1]}"
            raise ValueError(f"region: must put {size}, got ({row}, {col})")
        changed = self._cells.copy()
        changed[row : row + rows, col : col + cols] = patch
        changed.setflags(write=False)
        # All but the patch has been checked before.
        grid = object.__new__(OccupancyGrid)
        grid._cells, grid._resolution, grid._origin = changed, self._resolution, self._origin
        grid._occupied_threshold, grid._occupied = self._occupied_threshold, None
        return grid

    def bounds(self) -> tuple[float, float, float, float]:
        """The upright box around the grid in the world: (x_min, y_min, x_max, y_max) [m]."""
        corners = np.array([[0, 0], [self.width, 0], [0, self.height], [self.width, self.height]])
        world = self._to_world(corners)
        (x_min, y_min), (x_max, y_max) = world.min(axis=0).tolist(), world.max(axis=0).tolist()
        return x_min, y_min, x_max, y_max

    def cell_centers(self, rows: ArrayLike, cols: ArrayLike) -> NDArray[np.float64]:
        """The centres of cells in the world.

        Args:
            rows: (M,) integer rows. The lattice goes on beyond the grid, so any integer has a centre.
            cols: (M,) integer columns.

        Returns:
            (M, 2) x and y [m].

        Raises:
            TypeError: the indices are not integers.
            ValueError: the shapes are not (M,) and (M,).
        """
        row = checks.array("rows", rows, ("M",), dtype=np.int64)
        col = checks.array("cols", cols, row.shape, dtype=np.int64)
        return self._to_world((np.stack([col, row], axis=1) + 0.5) * self._resolution)

    def world_to_cells(self, xy: ArrayLike) -> NDArray[np.float64]:
        """World points in the grid's frame, in cell units.

        The point is moved by the origin, turned by -yaw about it and divided by the resolution, all in
        float64; the floor of the result is (col, row). With a yaw of exactly 0 nothing is turned.

        Args:
            xy: (M, 2) x and y [m].

        Returns:
            (M, 2) column and row coordinates [cells].

        Raises:
            TypeError: ``xy`` does not hold real numbers.
            ValueError: its shape is not (M, 2), or a value is not finite.
        """
        points = checks.array("xy", xy, ("M", 2))
        x, y, yaw = self._origin
        u, v = points[:, 0] - x, points[:, 1] - y
        if yaw != 0.0:
            c, s = math.cos(yaw), math.sin(yaw)
            u, v = c * u + s * v, c * v - s * u
        return np.stack([u, v], axis=1) / self._resolution

    def _to_world(self, local: NDArray[np.float64]) -> NDArray[np.float64]:
        """(M, 2) metres in the grid's frame to (M, 2) metres in the world."""
        x, y, yaw = self._origin
        u, v = local[:, 0], local[:, 1]
        if yaw != 0.0:
            c, s = math.cos(yaw), math.sin(yaw)
            u, v = c * u - s * v, s * u + c * v
        return np.stack([u + x, v + y], axis=1)

    def _key(self) -> tuple[Any, ...]:
        return self.shape, self._resolution, self._origin, self._occupied_threshold

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, OccupancyGrid):
            return NotImplemented
        return self._key() == other._key() and np.array_equal(self._cells, other._cells)

    def __hash__(self) -> int:
        return hash(self._key())

    def __repr__(self) -> str:
        rows, cols = self.shape
        return (
            f"OccupancyGrid({rows} x {cols} cells, resolution={self._resolution}, origin={self._origin}, "
            f"occupied_threshold={self._occupied_threshold})"
        )

    def __reduce__(self) -> tuple[Callable[..., OccupancyGrid], tuple[Any, ...]]:
        # Copies and pickles go through the constructor, so that their cells are read-only too.
        make = functools.partial(OccupancyGrid, occupied_threshold=self._occupied_threshold)
        return make, (self._cells, self._resolution, self._origin)


def _own_cells(cells: ArrayLike) -> NDArray[np.int8]:
    """A checked, read-only int8 copy of (H, W) occupancies."""
    given = checks.as_array("cells", cells)
    dtype = given.dtype if given.dtype.kind in "iu" else np.int64
    given = checks.array("cells", given, ("H", "W"), dtype=dtype)
    if given.size == 0:
        raise ValueError(f"cells: must hold at least one cell, got shape {given.shape}")
    if given.min() < -1 or given.max() > 100:
        row, col = np.argwhere((given < -1) | (given > 100))[0].tolist()
        raise ValueError(f"cells: every value must be from -1 to 100, got {given[row, col]} at index ({row}, {col})")
    own = np.array(given, dtype=np.int8, order="C")
    own.setflags(write=False)
    return own
