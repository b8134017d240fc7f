"""The part of a map that a cloud of particles can reach: everything else is left out until the cloud moves there."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gpusense.world.frames import Cells, Mount
from gpusense.world.grid import OccupancyGrid

# Poses that enclose others.
Corners = Sequence[tuple[float, float, float]]
# Maps smaller than this are prepared faster than it takes to think about it.
SMALLEST_CELLS = 1 << 20
# Distances in cells are squared in 32 bits, so no window may be longer.
LONGEST_SIDE = (1 << 15) - 1
# A region that covers more than this share of the map is not worth refreshing.
LARGEST_SHARE = 0.6
# Room to move, as a share of the reach, before a region is made anew.
SLACK = 0.5


@dataclass(frozen=True)
class Region:
    """Half-open window of a grid's rows and columns."""

    row: int
    col: int
    rows: int
    cols: int

    @property
    def cells(self) -> int:
        """Number of cells."""
        return self.rows * self.cols

    def contains(self, other: Region) -> bool:
        """Whether the other window lies inside."""
        return (
            self.row <= other.row
            and self.col <= other.col
            and other.row + other.rows <= self.row + self.rows
            and other.col + other.cols <= self.col + self.cols
        )

    def grown(self, by: int, shape: tuple[int, int]) -> Region:
        """The window with so many more cells on every side, as far as there are cells in an array of that shape."""
        row, col = max(self.row - by, 0), max(self.col - by, 0)
        bottom, right = min(self.row + self.rows + by, shape[0]), min(self.col + self.cols + by, shape[1])
        return Region(row, col, bottom - row, right - col)

    def shared(self, other: Region) -> Region | None:
        """The cells in both windows; None without any."""
        row, col = max(self.row, other.row), max(self.col, other.col)
        rows = min(self.row + self.rows, other.row + other.rows) - row
        cols = min(self.col + self.cols, other.col + other.cols) - col
        return Region(row, col, rows, cols) if rows > 0 and cols > 0 else None

    def moved(self, rows: int, cols: int) -> Region:
        """The window so many rows and columns farther on."""
        return Region(self.row + rows, self.col + cols, self.rows, self.cols)

    def cut(self, array: np.ndarray) -> np.ndarray:
        """The window of a (H, W) array."""
        return array[self.row : self.row + self.rows, self.col : self.col + self.cols]


Window = Region


def box(cells: np.ndarray) -> Region | None:
    """The smallest window of all that is True in a (H, W) array; None where nothing is."""
    rows, cols = np.flatnonzero(cells.any(axis=1)), np.flatnonzero(cells.any(axis=0))
    if len(rows) == 0:
        return None
    row, col = int(rows[0]), int(cols[0])
    return Region(row, col, int(rows[-1]) + 1 - row, int(cols[-1]) + 1 - col)


def whole(grid: OccupancyGrid) -> Region:
    """The window of all cells."""
    return Region(0, 0, *grid.shape)


def extent(grid: Cells, corners: Corners, mount: Mount) -> tuple[float, float, float, float]:
    """Least and largest column and row, in cells, that a sensor of poses within these corners can have.

    A call has four corners: numbers of Python's are faster than arrays of four.
    """
    from_x, from_y, yaw = grid.origin
    size, margin = grid.resolution, math.hypot(mount[0], mount[1]) / grid.resolution
    cos, sin = math.cos(yaw), math.sin(yaw)
    cols, rows = [], []
    for corner in corners:
        x, y = corner[0] - from_x, corner[1] - from_y
        if yaw != 0.0:
            x, y = cos * x + sin * y, cos * y - sin * x
        cols.append(x / size)
        rows.append(y / size)
    return min(cols) - margin, max(cols) + margin, min(rows) - margin, max(rows) + margin


def needed(grid: OccupancyGrid, corners: Corners, mount: Mount, reach: float, slack: float = 0.0) -> Region:
    """Smallest window that holds all cells within ``reach`` cells of any sensor, at least one cell.

    Args:
        grid: The map.
        corners: Poses [m, m, rad], at least one, between which all others lie.
        mount: The sensor's pose on the robot.
        reach: Longest distance in cells that matters, ring and rounding included.
        slack: Cells added on every side.
    """
    left, right, low, high = extent(grid, corners, mount)
    margin = reach + slack + 3
    rows, cols = grid.shape
    low_col, high_col = (int(min(max(v, 0), cols)) for v in (left - margin, right + margin))
    low_row, high_row = (int(min(max(v, 0), rows)) for v in (low - margin, high + margin))
    low_col, low_row = min(low_col, cols - 1), min(low_row, rows - 1)
    return Region(low_row, low_col, max(high_row - low_row, 1), max(high_col - low_col, 1))


def choose(grid: OccupancyGrid, current: Region | None, corners: Corners, mount: Mount, reach: float) -> Region:
    """The window to prepare for a cloud within these corners: the current one where it suffices, else one with room."""
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
        row, col = min(roomy.row, current.row), min(roomy.col, current.col)
        joined = Region(
            row,
            col,
            max(roomy.row + roomy.rows, current.row + current.rows) - row,
            max(roomy.col + roomy.cols, current.col + current.cols) - col,
        )
        # A cloud that jumped far away does not drag its old window along.
        near = joined.cells <= 2 * (roomy.cells + current.cells)
        roomy = joined if near and max(joined.rows, joined.cols) <= LONGEST_SIDE else roomy
    return everything if roomy.cells > LARGEST_SHARE * everything.cells and not long else roomy
