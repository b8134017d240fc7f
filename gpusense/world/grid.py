"""The map: an occupancy grid and its pose in the world."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpusense._util import checks
from gpusense._util.angles import wrapped
from gpusense._util.html import card, grey_png
from gpusense.world.messages import field, planar_pose, real_field
from gpusense.world.plausible import look_at_grid

SMALLEST_RESOLUTION, LARGEST_RESOLUTION = 1e-4, 1e3
"""Bounds of the side of a cell [m]."""
FARTHEST_ORIGIN = 1e9
"""Largest coordinate of a map's origin [m]."""
WIDEST = 240
"""Most pixels along a side."""


class GridFrame(NamedTuple):
    """Frame of a grid."""

    resolution: float  # side of a cell [m]
    origin: tuple[float, float, float]  # pose (x, y, yaw) of the outer corner of cell (0, 0) in the world [m, m, rad]

    def to_cells(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert (M, 2) points in the world [m] to column and row coordinates [cells], all in float64.

        A point is taken relative to the origin, rotated by -yaw and divided by the resolution. A yaw of exactly 0 skips
        the rotation.
        """
        x, y, yaw = self.origin
        u, v = points[:, 0] - x, points[:, 1] - y
        if yaw != 0.0:
            c, s = math.cos(yaw), math.sin(yaw)
            u, v = c * u + s * v, c * v - s * u
        return np.stack([u, v], axis=1) / self.resolution

    def to_world(self, local: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert (M, 2) points in the grid's frame to the world [m]."""
        x, y, yaw = self.origin
        u, v = local[:, 0], local[:, 1]
        if yaw != 0.0:
            c, s = math.cos(yaw), math.sin(yaw)
            u, v = c * u - s * v, s * u + c * v
        return np.stack([u + x, v + y], axis=1)


def check_resolution(value: object) -> float:
    """Return the side of a cell after checking its bounds [m]."""
    return checks.real("resolution", value, low=SMALLEST_RESOLUTION, high=LARGEST_RESOLUTION)


def check_origin(value: object) -> tuple[float, float, float]:
    """Return the pose of a map after checking it [m, m, rad]."""
    x, y, yaw = checks.array("origin", value, (3,)).tolist()
    for index, coordinate in enumerate((x, y)):
        checks.real(f"origin[{index}]", coordinate, low=-FARTHEST_ORIGIN, high=FARTHEST_ORIGIN)
    return x, y, yaw


class OccupancyGrid:
    """Immutable occupancy grid, as in ``nav_msgs/OccupancyGrid``.

    ``cells[row, col]`` covers the half-open square ``[col, col + 1) x [row, row + 1)`` in cell units, scaled by
    ``resolution``, rotated by the origin's yaw and translated to the origin. ``cells[0, 0]`` touches the origin. Axes
    follow REP-103: x along the columns, y along the rows, yaw counter-clockwise.

    Args:
        cells: (H, W) integers, at least one: occupancy in per cent, 0 to 100, or -1 for unknown. Copied.
        resolution: Side of a cell [m], 1e-4 to 1e3.
        origin: Pose (x, y, yaw) of the outer corner of ``cells[0, 0]`` in the world [m, m, rad]; x and y are at most
            1e9 m from 0, where float64 still resolves a thousandth of a millimetre.
        occupied_threshold: Least occupancy of an occupied cell [per cent], 1 to 100. The default equals map_server's
            ``occupied_thresh`` of 0.65.

    Raises:
        TypeError: An argument has the wrong type, such as cells of dtype float or bool.
        ValueError: A shape or a value breaks a rule above.

    Warns:
        PlausibilityWarning: Cells are larger than 1 m, or the origin's yaw is more than a turn.

    Example:
        >>> import gpusense as gs
        >>> grid = gs.OccupancyGrid([[0, 100, -1], [0, 0, 0]], resolution=0.5)
        >>> grid
        OccupancyGrid(2 x 3 cells, 16.7% occupied, resolution=0.5, origin=(0.0, 0.0, 0.0), occupied_threshold=65)
        >>> grid.bounds()
        (0.0, 0.0, 1.5, 1.0)
    """

    __slots__ = ("_cells", "_frame", "_occupied", "_occupied_threshold")

    def __init__(
        self,
        cells: ArrayLike,
        resolution: float = 0.05,
        origin: ArrayLike = (0.0, 0.0, 0.0),
        *,
        occupied_threshold: int = 65,
    ) -> None:
        self._place(_checked_cells(cells), resolution, origin, occupied_threshold)

    def _place(
        self, cells: NDArray[np.int8], resolution: object, origin: object, occupied_threshold: object
    ) -> OccupancyGrid:
        """Store checked cells, after checking all other arguments."""
        self._cells = cells
        self._frame = GridFrame(check_resolution(resolution), check_origin(origin))
        look_at_grid(*self._frame)
        self._occupied_threshold = checks.integer("occupied_threshold", occupied_threshold, low=1, high=100)
        self._occupied: NDArray[np.bool] | None = None
        return self

    @classmethod
    def from_message(cls, message: Any, *, occupied_threshold: int = 65) -> OccupancyGrid:
        """Make a map from a ``nav_msgs/OccupancyGrid``, without ROS.

        Args:
            message: Any object or mapping with the fields of the message: ``data`` (H * W values, row by row), and
                ``info`` with ``resolution``, ``width``, ``height`` and the pose ``origin``.
            occupied_threshold: Least occupancy of an occupied cell [per cent].

        Raises:
            TypeError: A field is absent or has the wrong type.
            ValueError: The number of cells differs from width times height, the origin is tilted, or a value breaks a
                rule of :class:`OccupancyGrid`.

        Example:
            >>> import gpusense as gs
            >>> origin = dict(position=dict(x=1.0, y=2.0, z=0.0), orientation=dict(x=0.0, y=0.0, z=0.0, w=1.0))
            >>> info = dict(resolution=0.1, width=3, height=2, origin=origin)
            >>> gs.OccupancyGrid.from_message(dict(info=info, data=[0, 0, 100, -1, 0, 0])).origin
            (1.0, 2.0, 0.0)
        """
        width, height = (
            checks.integer(f"message.info.{name}", field("message", message, f"info.{name}"), low=0)
            for name in ("width", "height")
        )
        raw = field("message", message, "data")
        data = np.frombuffer(raw, np.int8) if isinstance(raw, (bytes, bytearray)) else raw
        cells = checks.as_array("message.data", data).ravel()
        if cells.size != width * height:
            raise ValueError(f"message.data: must hold width * height = {width * height} cells, got {cells.size}")
        origin = planar_pose("message.info.origin", field("message", message, "info.origin"))
        resolution = real_field("message", message, "info.resolution")
        return cls(cells.reshape(height, width), resolution, origin, occupied_threshold=occupied_threshold)

    @property
    def cells(self) -> NDArray[np.int8]:
        """(H, W) occupancy in per cent, -1 where unknown; read-only."""
        return self._cells

    @property
    def resolution(self) -> float:
        """Side of a cell [m]."""
        return self._frame.resolution

    @property
    def origin(self) -> tuple[float, float, float]:
        """Pose (x, y, yaw) of the outer corner of ``cells[0, 0]`` in the world [m, m, rad]."""
        return self._frame.origin

    @property
    def occupied_threshold(self) -> int:
        """Least occupancy of an occupied cell [per cent]."""
        return self._occupied_threshold

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of rows and columns (H, W)."""
        rows, cols = self._cells.shape
        return rows, cols

    @property
    def width(self) -> float:
        """Extent along the columns, the x axis of the grid's frame [m]."""
        return self.shape[1] * self._frame.resolution

    @property
    def height(self) -> float:
        """Extent along the rows, the y axis of the grid's frame [m]."""
        return self.shape[0] * self._frame.resolution

    @property
    def occupied(self) -> NDArray[np.bool]:
        """(H, W) mask of cells with an occupancy of at least ``occupied_threshold``; computed once, read-only."""
        if self._occupied is None:
            occupied = self._cells >= self._occupied_threshold
            occupied.setflags(write=False)
            self._occupied = occupied
        return self._occupied

    @property
    def unknown(self) -> NDArray[np.bool]:
        """(H, W) mask of unknown cells."""
        return self._cells < 0

    @property
    def free(self) -> NDArray[np.bool]:
        """(H, W) mask of cells that are neither occupied nor unknown."""
        return (self._cells >= 0) & (self._cells < self._occupied_threshold)

    def obstacles(self, unknown: Literal["free", "occupied"] = "free") -> NDArray[np.bool]:
        """Return the mask of cells that stop a beam.

        Args:
            unknown: Whether unknown cells count as ``"free"`` or as ``"occupied"``.

        Returns:
            (H, W) bool; do not write to it.

        Raises:
            TypeError: ``unknown`` is not a string.
            ValueError: ``unknown`` is neither ``"free"`` nor ``"occupied"``.
        """
        checks.choice("unknown", unknown, ("free", "occupied"))
        if unknown == "free":
            return self.occupied
        # A single comparison: as an unsigned byte, -1 exceeds every threshold.
        return self._cells.view(np.uint8) >= self._occupied_threshold

    def with_cells(self, cells: ArrayLike, region: ArrayLike) -> OccupancyGrid:
        """Return a grid with some cells replaced.

        Args:
            cells: (h, w) integers, at least one: occupancy in per cent, 0 to 100, or -1 for unknown.
            region: (row, col) of the cell that ``cells[0, 0]`` replaces. The whole patch must be inside the grid.

        Raises:
            TypeError: ``cells`` or ``region`` does not hold integers.
            ValueError: A shape or a value breaks a rule above.
        """
        patch = _checked_cells(cells)
        row, col = checks.array("region", region, (2,), dtype=np.int64).tolist()
        rows, cols = patch.shape
        if not (0 <= row <= self.shape[0] - rows and 0 <= col <= self.shape[1] - cols):
            size = f"{rows} x {cols} cells within {self.shape[0]} x {self.shape[1]}"
            raise ValueError(f"region: must put {size}, got ({row}, {col})")
        changed = self._cells.copy()
        changed[row : row + rows, col : col + cols] = patch
        return grid_of_checked(changed, *self._frame, occupied_threshold=self._occupied_threshold)

    def bounds(self) -> tuple[float, float, float, float]:
        """Return the axis-aligned box around the grid in the world: (x_min, y_min, x_max, y_max) [m]."""
        corners = np.array([[0, 0], [self.width, 0], [0, self.height], [self.width, self.height]])
        world = self._to_world(corners)
        (x_min, y_min), (x_max, y_max) = world.min(axis=0).tolist(), world.max(axis=0).tolist()
        return x_min, y_min, x_max, y_max

    def cell_centers(self, rows: ArrayLike, cols: ArrayLike) -> NDArray[np.float64]:
        """Return the centres of cells in the world.

        Args:
            rows: (M,) integer rows. Indices outside the grid are allowed.
            cols: (M,) integer columns.

        Returns:
            (M, 2) x and y [m].

        Raises:
            TypeError: The indices are not integers.
            ValueError: The shapes are not (M,) and (M,).
        """
        row = checks.array("rows", rows, ("M",), dtype=np.int64)
        col = checks.array("cols", cols, row.shape, dtype=np.int64)
        return self._to_world((np.stack([col, row], axis=1) + 0.5) * self._frame.resolution)

    def world_to_cells(self, xy: ArrayLike) -> NDArray[np.float64]:
        """Convert world points to the grid's frame, in cell units.

        Points are translated by the origin, rotated by -yaw and divided by the resolution, all in float64; a yaw of
        exactly 0 skips the rotation. The floor of the result is (col, row).

        Args:
            xy: (M, 2) x and y [m].

        Returns:
            (M, 2) column and row coordinates [cells].

        Raises:
            TypeError: ``xy`` does not hold real numbers.
            ValueError: The shape is not (M, 2), or a value is not finite.
        """
        return self._frame.to_cells(checks.array("xy", xy, ("M", 2)))

    def _to_world(self, local: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert (M, 2) points in the grid's frame to the world [m]."""
        return self._frame.to_world(local)

    def _poses_to_world(self, local: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert (M, 3) poses in the grid's frame [cells, cells, rad] to the world, headings in [-pi, pi)."""
        xy = self._to_world(local[:, :2] * self.resolution)
        return np.column_stack([xy, wrapped(local[:, 2] + self.origin[2])])

    def _key(self) -> tuple[Any, ...]:
        return self.shape, self._frame, self._occupied_threshold

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, OccupancyGrid):
            return NotImplemented
        return self._key() == other._key() and np.array_equal(self._cells, other._cells)

    def __hash__(self) -> int:
        return hash(self._key())

    def __repr__(self) -> str:
        rows, cols = self.shape
        share = np.count_nonzero(self.occupied) / self._cells.size
        return (
            f"OccupancyGrid({rows} x {cols} cells, {100 * share:.3g}% occupied, resolution={self._frame.resolution}, "
            f"origin={self._frame.origin}, occupied_threshold={self._occupied_threshold})"
        )

    def _repr_html_(self) -> str:
        rows, cols = self.shape
        shares = ((name, np.count_nonzero(mask) / max(self._cells.size, 1)) for name, mask in
                  (("occupied", self.occupied), ("unknown", self.unknown)))  # fmt: skip
        table = [
            ("cells", f"{rows} x {cols} of {self._frame.resolution:g} m"),
            ("size [m]", f"{self.width:g} x {self.height:g}"),
            ("origin", self._frame.origin),
            *((name, f"{share:.1%}") for name, share in shares),
        ]
        return card("OccupancyGrid", table, picture=thumbnail(self.unknown, self.occupied))

    def __reduce__(self) -> tuple[Callable[..., OccupancyGrid], tuple[Any, ...]]:
        # Copies and pickles call the constructor, which makes their cells read-only.
        make = functools.partial(OccupancyGrid, occupied_threshold=self._occupied_threshold)
        return make, (self._cells, *self._frame)


def grid_of_checked(
    cells: NDArray[np.int8], resolution: object, origin: object, *, occupied_threshold: int
) -> OccupancyGrid:
    """Make a map from valid (H, W) occupancies without copying; the array becomes read-only."""
    kept = np.ascontiguousarray(cells)
    kept.setflags(write=False)
    return object.__new__(OccupancyGrid)._place(kept, resolution, origin, occupied_threshold)


def _checked_cells(cells: ArrayLike) -> NDArray[np.int8]:
    """Check (H, W) occupancies and return a read-only int8 copy."""
    values = checks.as_array("cells", cells)
    if values.dtype.kind in "bf" and values.size:
        convert = "100 * cells" if values.dtype.kind == "b" else "(100 * cells).round().astype(int)"
        raise TypeError(f"cells: must hold integers from -1 to 100, got dtype {values.dtype}; pass {convert}")
    dtype = values.dtype if values.dtype.kind in "iu" else np.int64
    values = checks.array("cells", values, ("H", "W"), dtype=dtype)
    if values.size == 0:
        raise ValueError(f"cells: must hold at least one cell, got shape {values.shape}")
    if values.min() < -1 or values.max() > 100:
        row, col = np.argwhere((values < -1) | (values > 100))[0].tolist()
        raise ValueError(f"cells: every value must be from -1 to 100, got {values[row, col]} at index ({row}, {col})")
    copy = np.array(values, dtype=np.int8, order="C")
    copy.setflags(write=False)
    return copy


# Greys of free, unknown and occupied cells; a pixel takes the darkest of its cells, so that walls remain.
_FREE, _UNKNOWN, _OCCUPIED = 255, 205, 60


def thumbnail(unknown: np.ndarray, occupied: np.ndarray) -> bytes:
    """Return a PNG of a map, given its (H, W) masks, with row 0 at the bottom; empty for a map without cells."""
    if not occupied.size:
        return b""
    grey = np.full(occupied.shape, _FREE, np.uint8)
    grey[unknown] = _UNKNOWN
    grey[occupied] = _OCCUPIED
    step = -(-max(occupied.shape) // WIDEST)
    for axis in (0, 1):
        grey = np.minimum.reduceat(grey, np.arange(0, grey.shape[axis], step), axis=axis)
    return grey_png(grey[::-1])
