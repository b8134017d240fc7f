"""Choose windows of a map: the part within reach of a cloud of particles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gpusense.interface import structs
from gpusense.world.frames import Cells, Mount
from gpusense.world.grid import OccupancyGrid

# Poses [m, m, rad] that span a box around a cloud.
Corners = Sequence[tuple[float, float, float]]
# A map with fewer cells is prepared as a whole.
SMALLEST_CELLS = 1 << 20
# Longest side of a window [cells]: distances in cells are squared in 32 bits.
LONGEST_SIDE = (1 << 15) - 1
# A larger share of the map's cells is replaced by the whole map.
LARGEST_SHARE = 0.6
# Margin for motion around a new window, as a share of the reach.
SLACK = 0.5


class Window(structs.Window):
    """Half-open window of a grid's rows and columns.

    Attributes:
        row: First row.
        col: First column.
        rows: Number of rows.
        cols: Number of columns.
    """

    __slots__ = ()

    @property
    def cells(self) -> int:
        """Number of cells."""
        return self.rows * self.cols

    def contains(self, other: Window) -> bool:
        """Return whether ``other`` lies inside this window."""
        return (
            self.row <= other.row
            and self.col <= other.col
            and other.row + other.rows <= self.row + self.rows
            and other.col + other.cols <= self.col + self.cols
        )

    def grown(self, margin: int, shape: tuple[int, int]) -> Window:
        """Return this window with ``margin`` more cells on every side, clamped to an array of shape ``shape``."""
        row, col = max(self.row - margin, 0), max(self.col - margin, 0)
        bottom, right = min(self.row + self.rows + margin, shape[0]), min(self.col + self.cols + margin, shape[1])
        return Window(row, col, bottom - row, right - col)

    def shared(self, other: Window) -> Window | None:
        """Return the intersection with ``other``; None if it is empty."""
        row, col = max(self.row, other.row), max(self.col, other.col)
        rows = min(self.row + self.rows, other.row + other.rows) - row
        cols = min(self.col + self.cols, other.col + other.cols) - col
        return Window(row, col, rows, cols) if rows > 0 and cols > 0 else None

    def joined(self, other: Window) -> Window:
        """Return the smallest window that contains this one and ``other``."""
        row, col = min(self.row, other.row), min(self.col, other.col)
        return Window(
            row,
            col,
            max(self.row + self.rows, other.row + other.rows) - row,
            max(self.col + self.cols, other.col + other.cols) - col,
        )

    def moved(self, rows: int, cols: int) -> Window:
        """Return this window translated by ``rows`` and ``cols``."""
        return Window(self.row + rows, self.col + cols, self.rows, self.cols)

    def cut(self, array: np.ndarray) -> np.ndarray:
        """Return the part of an (H, W) array in this window, as a view."""
        return array[self.row : self.row + self.rows, self.col : self.col + self.cols]


class Frame(NamedTuple):
    """The frame in which poses are placed."""

    window: Window  # the part of the map that the table covers
    cells: Cells  # the map's shape, resolution and origin
    mount: Mount  # the sensor's pose on the robot; its yaw belongs to the bearings


def box(cells: np.ndarray) -> Window | None:
    """Return the smallest window around all True cells of an (H, W) array; None without any."""
    rows, cols = np.flatnonzero(cells.any(axis=1)), np.flatnonzero(cells.any(axis=0))
    if len(rows) == 0:
        return None
    row, col = int(rows[0]), int(cols[0])
    return Window(row, col, int(rows[-1]) + 1 - row, int(cols[-1]) + 1 - col)


def whole(grid: OccupancyGrid) -> Window:
    """Return the window of all cells."""
    return Window(0, 0, *grid.shape)


def extent(grid: Cells, corners: Corners, mount: Mount) -> tuple[float, float, float, float]:
    """Return bounds of the sensor's position for poses within ``corners``.

    For the four corners of a call, Python's numbers are faster than arrays.

    Returns:
        Least and largest column, least and largest row [cells].
    """
    from_x, from_y, yaw = grid.origin
    size, margin = grid.resolution, math.hypot(mount[0], mount[1]) / grid.resolution
    cos, sin = math.cos(yaw), math.sin(yaw)
    cols, rows = [], []
    # Two opposite corners bound an axis-aligned box.
    for corner in corners if yaw != 0.0 else corners[::3]:
        x, y = corner[0] - from_x, corner[1] - from_y
        if yaw != 0.0:
            x, y = cos * x + sin * y, cos * y - sin * x
        cols.append(x / size)
        rows.append(y / size)
    return min(cols) - margin, max(cols) + margin, min(rows) - margin, max(rows) + margin


def needed(grid: OccupancyGrid, corners: Corners, mount: Mount, reach: float, slack: float = 0.0) -> Window:
    """Return the smallest window that holds all cells within ``reach`` cells of any sensor, at least one cell.

    ``corners``: poses [m, m, rad], at least one, that span a box around all poses; ``mount``: the sensor's pose on the
    robot; ``reach``: longest distance that matters, ring and rounding included [cells]; ``slack``: additional margin on
    every side [cells].
    """
    left, right, low, high = extent(grid, corners, mount)
    margin = reach + slack + 3
    rows, cols = grid.shape
    low_col, high_col = (int(min(max(v, 0), cols)) for v in (left - margin, right + margin))
    low_row, high_row = (int(min(max(v, 0), rows)) for v in (low - margin, high + margin))
    low_col, low_row = min(low_col, cols - 1), min(low_row, rows - 1)
    return Window(low_row, low_col, max(high_row - low_row, 1), max(high_col - low_col, 1))


def choose(grid: OccupancyGrid, current: Window | None, corners: Corners, mount: Mount, reach: float) -> Window:
    """Choose the window to prepare for a cloud of poses within ``corners``.

    Returns:
        ``current`` if it suffices, else a window with a margin for motion, or the whole map.
    """
    everything = whole(grid)
    long = max(grid.shape) > LONGEST_SIDE
    if current == everything or (everything.cells < SMALLEST_CELLS and not long):
        return everything
    least = needed(grid, corners, mount, reach)
    if current is not None and current.contains(least):
        return current
    roomy = needed(grid, corners, mount, reach, SLACK * reach)
    if max(roomy.rows, roomy.cols) > LONGEST_SIDE:
        roomy = least
    if current is not None:
        joined = roomy.joined(current)
        # Drop the old window after a jump, since the joint window would be much larger than both.
        near = joined.cells <= 2 * (roomy.cells + current.cells)
        roomy = joined if near and max(joined.rows, joined.cols) <= LONGEST_SIDE else roomy
    return everything if roomy.cells > LARGEST_SHARE * everything.cells and not long else roomy
