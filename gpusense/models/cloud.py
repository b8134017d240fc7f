"""Poses of one call on their way to a device: checked, bounded, placed in a window of the map, and put in an order.

NumPy arrays are checked and bounded here; arrays that are on the device already stay there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np

from gpusense._util import checks
from gpusense.backends import arrays
from gpusense.backends.base import Backend, Buffer, Sharing
from gpusense.backends.workspace import Workspace
from gpusense.reference.error_free import BLOCK_TERMS
from gpusense.reference.heading import LIMIT
from gpusense.reference.order import ALL_BINS, STRETCH
from gpusense.reference.tiles import TILE, TILE_PARTICLES, TILE_RAYS
from gpusense.tables.reachable import ReachableMap
from gpusense.world.frames import Cells, Mount, frame_scalars, place_poses
from gpusense.world.grid import OccupancyGrid
from gpusense.world.windows import Corners, Region, extent

_INT = np.dtype(np.int32)
_SINGLE_TYPE, _DOUBLE_TYPE = np.dtype(np.float32), np.dtype(np.float64)
_PLAIN, _HUGE = frozenset[str](), frozenset({"HUGE_HEADINGS"})
_SINGLE = _HUGE | {"POSES_FLOAT32"}
_UNBOUNDED = np.full(7, -(1 << 31), _INT)
# Poses whose bounds are found at once.
_BOUNDED = 8192
# Particle-beams from which the time that an order saves is more than what it takes, and as many particles.
LEAST_ORDERED = (1 << 22, 1 << 12)


@dataclass(frozen=True)
class Placed:
    """Sensors in the frame of a window, on the device: cells, poses, and what rounding took from these."""

    cell: Buffer
    pose: Buffer
    low: Buffer


@dataclass(frozen=True)
class Readings:
    """Readings on the device that the launch which places poses places too; see the kernel file ``scan``.

    Attributes:
        head: Work-items for them.
        flags: What they change of the kernel's code.
        arrays: Its arguments from ``ranges`` to ``fixed``.
        numbers: Its arguments from ``beams`` to ``guard_scale``.
    """

    head: int
    flags: frozenset[str]
    arrays: tuple[Buffer, ...]
    numbers: tuple[float, ...]


class Cloud:
    """(N, 3) poses.

    Args:
        poses: Numbers, or an array on the device.
        backend: The device.
        name: What messages call them.
        several: An array on the device is (S, N, 3), the poses of S scans one after the other.
        in_place: An array on the device must be used where it is, now and later.

    Raises:
        TypeError: not numbers, or an array that this device cannot read.
        ValueError: another shape, or, of arrays that are not on the device, a value that is not finite.
    """

    def __init__(
        self, poses: object, backend: Backend, name: str = "poses", *, several: bool = False, in_place: bool = False
    ) -> None:
        self.host: np.ndarray | None = None
        self.on_device = arrays.on_device(poses)
        if self.on_device:
            found = arrays.adopt_poses(poses, backend, name, several, in_place=in_place)
            self._buffer, self.count, self._single, self._owner = found
            return
        given = arrays.to_host(poses, name)
        if isinstance(given, np.ndarray) and given.dtype.kind == "f" and given.ndim == 2 and given.shape[1] == 3:
            self.host = np.ascontiguousarray(given, np.float64)
            self._corners = self._bounds(0, len(given))
            if not all(map(math.isfinite, (*self._corners[0], *self._corners[3]))):
                self.host = checks.array(name, given, ("N", 3))
        else:
            self.host = np.ascontiguousarray(checks.array(name, given, ("N", 3)))
            self._corners = self._bounds(0, len(self.host))
        self.count, self._single = len(self.host), False

    def __len__(self) -> int:
        return self.count

    def corners(self, begin: int, end: int) -> Corners:
        """Four corners of the box that holds some poses; the corners of no poses are at 0."""
        return self._corners if end - begin == self.count else self._bounds(begin, end)

    def _bounds(self, begin: int, end: int) -> Corners:
        assert self.host is not None
        if begin == end:
            return ((0.0, 0.0, 0.0),) * 4
        low, high = _bounds(self.host[begin:end])
        return low, (low[0], high[1], low[2]), (high[0], low[1], high[2]), high

    def ensure(self, table: ReachableMap, begin: int, end: int) -> tuple[Buffer, Region, Corners | None]:
        """The map's table for some poses, its window, and the corners of these poses where they are known."""
        if self.host is None:
            return *table.ensure(None), None
        corners = self.corners(begin, end)
        return *table.ensure(corners), corners

    def given(self, backend: Backend, space: Workspace, part: tuple[int, int]) -> Buffer:
        """Poses part[0] to part[1] - 1 on the device, as they were given; None where the host is to place them."""
        begin, count = part[0], part[1] - part[0]
        if self.host is None:
            return self._part_on_device(backend, space, 3 * begin, 3 * count)
        return space.upload("poses", self.host[begin : part[1]]) if backend.info.float64 else None

    def _part_on_device(self, backend: Backend, space: Workspace, first: int, count: int) -> Buffer:
        """Some numbers of poses on the device; a copy where it cannot begin with them."""
        sharing, dtype = cast(Sharing, backend), _SINGLE_TYPE if self._single else _DOUBLE_TYPE
        if first * dtype.itemsize % sharing.alignment == 0:
            return backend.part(self._buffer, first, count, dtype)
        copied = space.empty("given", count, dtype)
        sharing.copy(self._buffer, copied, count * dtype.itemsize, begin=first * dtype.itemsize)
        return copied

    def code(self) -> frozenset[str]:
        """The flags of ``place_poses`` that these poses need."""
        if self.host is None:
            return _SINGLE if self._single else _HUGE
        return _HUGE if max(-self._corners[0][2], self._corners[3][2]) > LIMIT else _PLAIN

    def headings(self) -> frozenset[str]:
        """The flag of headings that may be huge; nobody has looked at those of poses on the device."""
        return self.code() & _HUGE

    def place(
        self,
        backend: Backend,
        space: Workspace,
        given: Buffer,
        part: tuple[int, int],
        frame: tuple[Region, Cells, Mount],
        real: np.dtype,
        *,
        careful: bool,
        readings: Readings | None = None,
    ) -> Placed:
        """Poses part[0] to part[1] - 1, which are ``given``, in the frame of a window, and readings along with them."""
        (begin, end), (region, grid, mount) = part, frame
        count = end - begin
        if given is None:
            return self._place_on_host(space, part, frame, real, careful)
        flags = self.code() | ({"FLOAT64"} if real == np.float64 else set()) | ({"CAREFUL"} if careful else set())
        cell, pose = space.empty("cell", 2 * count, _INT), space.empty("pose", 4 * count, real)
        low = space.empty("pose_low", 4 * count if careful else 4, real)
        verdict = space.empty("verdict", 2, _INT, zero=True)
        buffers = (given, cell, pose, low, verdict)
        numbers = (*frame_scalars(grid, mount), region.col, region.row, region.rows, region.cols, count)
        if readings is None:
            backend.compile("place_poses", flags)((count,), *buffers, *numbers)
        else:
            head = readings.head
            backend.compile("place_inputs", flags | readings.flags)(
                (head + count,), *buffers, *readings.arrays, *numbers, head, *readings.numbers
            )
        return Placed(cell, pose, low)

    def _place_on_host(
        self,
        space: Workspace,
        part: tuple[int, int],
        frame: tuple[Region, Cells, Mount],
        real: np.dtype,
        careful: bool,
    ) -> Placed:
        assert self.host is not None
        region, grid, mount = frame
        placed = place_poses(self.host[slice(*part)], grid, mount, real)
        placed.cell[:] -= (region.col, region.row)
        low = placed.low if careful else placed.low[:1]
        cell, pose = space.upload("cell", placed.cell), space.upload("pose", placed.pose)
        return Placed(cell, pose, space.upload("pose_low", low))


def finish(space: Workspace, on_device: bool, name: str = "poses") -> None:
    """Wait for a call to end.

    Raises:
        ValueError: a pose on the device that was placed in it was not finite.
    """
    finish_all([(space, on_device)], name)


def finish_all(spaces: Sequence[tuple[Workspace, bool]], name: str = "poses") -> None:
    """Wait for a call that used one workspace or several of a device to end.

    Args:
        spaces: Each workspace, and whether it had poses that are on the device.
        name: What messages call the poses.

    Raises:
        ValueError: a pose on the device that was placed in it was not finite.
    """
    verdicts = np.zeros((len(spaces), 2), _INT)
    for (space, on_device), verdict in zip(spaces, verdicts, strict=True):
        if on_device:
            space.download(space.empty("verdict", 2, _INT, zero=True), verdict)
    for space, _ in spaces:
        # All that a device has to do is done after the first.
        space.wait()
    for (space, _), verdict in zip(spaces, verdicts, strict=True):
        if verdict[0]:
            space.upload("verdict", np.zeros(2, _INT))
            space.wait()
    if verdicts[:, 0].any():
        raise ValueError(f"{name}: must be finite, got a pose on the device that is not")


def _bounds(poses: np.ndarray) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Least and largest of each column of (N, 3) numbers, N > 0, NaN where there is one.

    Columns of three are slow to reduce: turned into rows, as many at a time as the nearest cache holds, they are not.
    """
    lows, highs = [], []
    for begin in range(0, len(poses), _BOUNDED):
        rows = np.ascontiguousarray(poses[begin : begin + _BOUNDED].T)
        lows.append(np.minimum.reduce(rows, axis=1))
        highs.append(np.maximum.reduce(rows, axis=1))
    # Several blocks: NaN stays.
    low = lows[0] if len(lows) == 1 else np.minimum.reduce(lows)
    high = highs[0] if len(highs) == 1 else np.maximum.reduce(highs)
    (x, y, turn), (far_x, far_y, far_turn) = low.tolist(), high.tolist()
    return (x, y, turn), (far_x, far_y, far_turn)


def all_within(
    corners: Corners | None, grid: OccupancyGrid, mount: Mount, region: Region, reach: float, ring: int = 0
) -> bool:
    """Whether everything within reach cells of the sensors surely lies in a window and a ring around it."""
    if corners is None:
        return False
    left, right, low, high = extent(grid, corners, mount)
    reach += 1
    return bool(
        left - reach >= region.col - ring
        and right + reach <= region.col + region.cols + ring
        and low - reach >= region.row - ring
        and high + reach <= region.row + region.rows + ring
    )


def ordered(backend: Backend, space: Workspace, placed: Placed, count: int, rays: int, real: np.dtype) -> Buffer | None:
    """An order of the particles that makes rays coherent, where that pays; see the kernel file ``order``."""
    if count * rays < LEAST_ORDERED[0] or count < LEAST_ORDERED[1]:
        return None
    flags = frozenset({"FLOAT64"} if real == np.float64 else ())
    bounds, bins = space.upload("bounds", _UNBOUNDED), space.empty("bins", ALL_BINS, _INT)
    bin_of, order = space.empty("bin_of", count, _INT), space.empty("order", count, _INT)
    backend.compile("order_bounds", flags)((ALL_BINS,), placed.cell, placed.pose, bounds, bins, count)
    backend.compile("order_count", flags)((count,), placed.cell, placed.pose, bounds, bins, bin_of, count)
    backend.compile("order_starts", flags)((ALL_BINS // STRETCH,), bounds, bins)
    backend.compile("order_fill", flags)((count,), bin_of, bins, order, count)
    return order


# Work-items that fill any device, and the tiles of the kernel file ``tiles``.
_ENOUGH = 1 << 21
# The same for the likelihood field, whose work-items are short, so that their beginnings count.
ENOUGH_SHORT = 1 << 19


def spread_of(items: int, groups: int, enough: int) -> int:
    """By how many powers of two to split the work of some work-items, each with so many groups of readings or rays."""
    spread = 0
    while items << spread < enough and 1 << spread < groups:
        spread += 1
    return spread


def stranded(rays: int, spread: int) -> bool:
    """Whether a launch in tiles has a block of rays for each of a tile's groups: then work-items add up strands."""
    return -(-rays // BLOCK_TERMS) >= 1 << spread


def tiles_of(count: int, rays: int) -> tuple[int, int]:
    """Work-items of a launch in tiles of particles and rays, and its spread."""
    tiles = -(-count // TILE_PARTICLES)
    spread = spread_of(tiles * TILE, -(-rays // TILE_RAYS), _ENOUGH)
    return (tiles << spread) * TILE, spread
