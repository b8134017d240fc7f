"""Poses of a request: checks, bounds, and placement in a window of the map.

NumPy arrays are checked and bounded on the host, or by a GPU where they are many, which also converts those in float32;
the values of device poses are not inspected before the launch that places them.
"""

from __future__ import annotations

import math
from collections.abc import Hashable
from typing import NamedTuple

import numpy as np

from gpusense.backends import Backend, arrays
from gpusense.backends.arrays import Bounds
from gpusense.backends.base import Buffer
from gpusense.backends.workspace import POSE_STATUS, Workspace
from gpusense.interface.constants import LARGEST_HEADING
from gpusense.interface.flags import flags_if
from gpusense.interface.lanes import with_lanes_flag
from gpusense.interface.launches import Program, launch
from gpusense.tables.reachable import MapState, ReachableMap
from gpusense.tables.world_index import InWorlds, WorldIndex
from gpusense.world.frames import frame_of, place_poses
from gpusense.world.windows import Corners, Frame, extent

_INT = np.dtype(np.int32)
_SINGLE, _DOUBLE = np.dtype(np.float32), np.dtype(np.float64)
_PLAIN, _HUGE = frozenset[str](), frozenset({"HUGE_HEADINGS"})
_SINGLE_PLAIN = frozenset({"POSES_FLOAT32"})
_HUGE_SINGLE = _HUGE | _SINGLE_PLAIN
# Number of poses from which on the wait for the device is shorter than the host's pass over them.
LEAST_BOUNDED = 1 << 16
# Work-items of the two launches, for each of three columns.
_ITEMS = (3 << 14, 3 << 9)

Part = tuple[int, int]
"""Poses from a first one to before a last one."""


class Poses:
    """(N, 3) poses of a request, or (S, N, 3) with ``scans``.

    ``in_place``: an array on the device must be used without a copy, now and later; ``late``: a GPU may bound many host
    poses when their corners are asked for first.
    """

    # The worlds of the poses; None in a single map.
    inside: WorldIndex | None = None

    # Flags of kernels that place them, in host memory the part of which the corners were asked for last.
    flags: frozenset[str] = _HUGE

    def __init__(
        self, poses: object, backend: Backend, name: str = "poses", *, scans: int | None = None, in_place: bool = False,
        late: bool = False,
    ) -> None:  # fmt: skip
        self.host: np.ndarray | None = None
        self._name, self._scans = name, scans
        self._last_corners: tuple[Part, Corners] | None = None
        # Farthest that launches move a pose [m].
        self.reach = 0.0
        # Poses that a workspace has on the device before they are placed.
        self._ahead: tuple[Part, Workspace, Buffer] | None = None
        self.on_device = type(poses) is not np.ndarray and arrays.on_device(poses)
        if self.on_device:
            self._buffer, self.count, single, self._owner = arrays.adopt_poses(
                poses, backend, name, scans, in_place=in_place
            )
            self._dtype = _SINGLE if single else _DOUBLE
            self.flags |= _SINGLE_PLAIN if single else _PLAIN
            return
        self.host = arrays.host_poses(poses, name, scans, single=late)
        self.count = len(self.host)
        self._late = late and self.count >= LEAST_BOUNDED and bounds_poses(backend)
        if not self._late:
            self.host = self.host.astype(np.float64, copy=False)
        self._dtype = self.host.dtype
        if not self._late:
            self._bound((0, self.count), backend, None)

    def corners(self, part: Part, backend: Backend, space: Workspace | None = None) -> Corners | None:
        """Return four corners of the box of some poses, at 0 for no poses; None on the device.

        ``space``: holds many poses on the device, which bounds them; None where no launch follows.
        """
        if self.host is None:
            return None
        if self._last_corners is None or self._last_corners[0] != part:
            self._bound(part, backend, space)
        assert self._last_corners is not None
        return self._last_corners[1]

    def _bound(self, part: Part, backend: Backend, space: Workspace | None) -> None:
        """Find the corners of the box of some host poses."""
        assert self.host is not None
        count, poses = part[1] - part[0], self.host[slice(*part)]
        if self._late and space is not None and count >= LEAST_BOUNDED:
            self._ahead = part, space, space.upload("poses", poses)
            bounds = bounds_on_device(backend, space, self._ahead[2], count, single=self._dtype == _SINGLE)
        else:
            bounds = arrays.bounds_of(poses)
        # The bounds, which calls need anyway, reveal NaN and infinities.
        if not all(map(math.isfinite, (*bounds[0], *bounds[1]))):
            arrays.refuse_poses(self.host, self._name, self._scans)
        (x, y, turn), (far_x, far_y, far_turn), reach = *bounds, self.reach
        wide = (x - reach, y - reach, turn - 4 * reach), (far_x + reach, far_y + reach, far_turn + 4 * reach)
        corners = corners_of(wide if reach else bounds)
        self._last_corners, huge = (part, corners), max(-corners[0][2], corners[3][2]) > LARGEST_HEADING
        if self._dtype == _SINGLE:
            self.flags = _HUGE_SINGLE if huge else _SINGLE_PLAIN
        else:
            self.flags = _HUGE if huge else _PLAIN

    def ensure_table(
        self, reachable: ReachableMap, part: Part, backend: Backend, space: Workspace | None = None
    ) -> MapState:
        """Return the map with a table for some poses."""
        return reachable.ensure(self.corners(part, backend, space))

    @property
    def sights(self) -> int:
        """Numbers of the sights of each pose."""
        return 0 if self.inside is None else self.inside.sights

    def buffer(self, backend: Backend, space: Workspace, part: Part) -> Buffer:
        """Return some poses on the device, uploaded from host memory; None where the host must place them."""
        begin, end = part
        if self.host is None:
            return self._device_part(backend, space, 3 * begin, 3 * (end - begin))
        ahead, self._ahead = self._ahead, None
        if ahead is not None and ahead[0] == part and ahead[1] is space:
            return ahead[2]
        return space.upload("poses", self.host[begin:end]) if backend.info.float64 else None

    def _device_part(self, backend: Backend, space: Workspace, first: int, count: int) -> Buffer:
        """Return some numbers of device poses; a copy where the device cannot address a part that begins with them."""
        size = self._dtype.itemsize
        if first * size % backend.alignment == 0:
            return backend.part(self._buffer, first, count, self._dtype)
        copied = space.empty("poses_part", count, self._dtype)
        backend.copy(self._buffer, copied, count * size, begin=first * size)
        return copied


class PlacedPoses(NamedTuple):
    """Sensor poses in the frame of a window, on the device."""

    # Their number.
    count: int  # type: ignore[assignment]  # hides tuple.count
    corners: Corners | None  # corners of the box of the robot's poses; None where they are not known
    frame: Frame
    space: Workspace  # the workspace, which holds their buffers
    real: np.dtype  # precision of the buffers
    lows: int  # numbers of ``low``
    flags: frozenset[str]  # flags of the kernels that place them
    source: Buffer = None  # the poses of the request; None where the host has placed them
    lanes: int = 1  # particles that the device computes at once
    inside: InWorlds | None = None  # the worlds of the poses; None in a single map

    @property
    def cell(self) -> Buffer:
        """Cells, int2."""
        return self.space.empty("cell", 2 * self.count, _INT)

    @property
    def pose(self) -> Buffer:
        """Fractions of the cell in x and y, cosines and sines of the headings, real4."""
        return self.space.empty("pose", 4 * self.count, self.real)

    @property
    def low(self) -> Buffer:
        """Rounding errors (low parts) of ``pose``, real4."""
        return self.space.empty("pose_low", self.lows, self.real)

    @property
    def headings(self) -> frozenset[str]:
        """The flag of huge headings; device poses always have it, since they are not inspected."""
        return self.flags & _HUGE

    @property
    def key(self) -> Hashable:
        """All values on which the launches depend, except buffers."""
        inside = self.inside
        where = None if inside is None else (inside.crowd, inside.sights, inside.wide, inside.wide_ignore)
        return self.flags, self.count, self.frame.window, where

    @property
    def world_flags(self) -> frozenset[str]:
        """Flags of kernels that cast rays in worlds."""
        return _PLAIN if self.inside is None else self.inside.flags

    def within(self, reach: float, ring: int = 0) -> bool:
        """Return whether all cells within ``reach`` of the sensors are surely in the window and a ring around it."""
        if self.corners is None or not (self.inside is None or self.inside.worlds.uniform):
            return False
        window, frame = self.frame.window, self.frame
        left, right, low, high = extent(frame.cells, self.corners, frame.mount)
        reach += 1
        return (
            left - reach >= window.col - ring
            and right + reach <= window.col + window.cols + ring
            and low - reach >= window.row - ring
            and high + reach <= window.row + window.rows + ring
        )

    @property
    def world(self) -> Buffer:
        """Two pairs of numbers of each pose, and its sights; see the kernel file ``shapes``."""
        assert self.inside is not None
        return self.space.empty("world", (4 + self.inside.sights) * self.count, _INT)

    def changing(self) -> dict[str, object]:
        """Return the arguments of ``place_in_worlds`` that change from call to call, by name."""
        assert self.inside is not None
        return dict(index=self.inside.index, ignore=self.inside.ignore)

    def places(self) -> dict[str, object]:
        """Return the arguments of kernels that cast rays in worlds, by name."""
        if self.inside is None:
            return {}
        table = self.inside.worlds.crowd.table(self.real)
        return dict(world=self.world, shapes=table, crowd=self.inside.crowd_of(self.count))

    def arguments(self) -> dict[str, object]:
        """Return the arguments of ``place_poses`` by name."""
        return dict(
            poses=self.source, pose_cell=self.cell, pose=self.pose, pose_low=self.low,
            pose_status=pose_status(self.space), frame=frame_of(self.frame.cells, self.frame.mount),
            window=self.frame.window, particles=self.count,
        )  # fmt: skip

    def launches(self) -> Program:
        """Return the launches that place them; none where the host has placed them."""
        if self.source is None:
            return ()
        if self.inside is not None:
            inside, arguments = self.inside, self.arguments()
            del arguments["window"]
            sees = inside.sights > 0
            flags = self.flags | inside.flags | flags_if(SEES=sees)
            placed = (
                launch(
                    "place_in_worlds", flags, (self.count,), **arguments, **self.places(), index=inside.index,
                    ignore=inside.ignore, frames=inside.worlds.frames, worlds=len(inside.worlds), wide=inside.wide,
                    wide_ignore=inside.wide_ignore,
                ),
            )  # fmt: skip
            if not sees:
                return placed
            crowd, flags = inside.crowd, inside.flags | (self.flags & {"FLOAT64"})
            items = self.count * (crowd.discs + crowd.boxes + crowd.segments)
            return (
                *placed,
                launch(
                    "find_sights", flags, (items,), **self.places(), sights=self.world, pose_cell=self.cell,
                    pose=self.pose, particles=self.count,
                ),
            )  # fmt: skip
        return (
            launch(
                "place_poses", with_lanes_flag(self.lanes, "place_poses", self.flags), (self.count,), **self.arguments()
            ),
        )


def place(
    poses: Poses, part: Part, frame: Frame, backend: Backend, space: Workspace, real: np.dtype,
    corners: Corners | None = None, *, careful: bool = False, sees: bool = False,
) -> PlacedPoses:  # fmt: skip
    """Upload some poses, and describe their placement in the frame of a window.

    ``careful``: whether low parts are needed; ``sees``: whether they cast rays, which need sights in worlds with
    shapes.
    """
    count, corners = part[1] - part[0], corners or poses.corners(part, backend, space)
    flags = poses.flags
    source, lows = poses.buffer(backend, space, part), 4 * count if careful else 4
    inside = None if poses.inside is None else poses.inside.buffers(backend, space, part, sees=sees)
    if source is None:
        if inside is not None:
            raise ValueError(f"grid: must be a single map on {backend.info.name}, which has no float64, got Worlds")
        _place_on_host(poses, part, frame, space, real, careful=careful)
        return PlacedPoses(count, corners, frame, space, real, lows, flags)
    flags |= flags_if(FLOAT64=real == _DOUBLE, TWO_PART_POINTS=careful)
    return PlacedPoses(count, corners, frame, space, real, lows, flags, source, backend.info.lanes, inside)


def pose_status(space: Workspace) -> Buffer:
    """Return the buffer of the non-finite flag."""
    return space.empty(POSE_STATUS[0], 2, POSE_STATUS[1], zero=True)


def _place_on_host(poses: Poses, part: Part, frame: Frame, space: Workspace, real: np.dtype, *, careful: bool) -> None:
    """Place some poses on the host, and upload them."""
    assert poses.host is not None
    placed = place_poses(poses.host[slice(*part)], frame.cells, frame.mount, real)
    placed.cell[:] -= (frame.window.col, frame.window.row)
    for name, numbers in (("cell", placed.cell), ("pose", placed.pose), ("pose_low", placed.low)):
        space.upload(name, numbers if careful or name != "pose_low" else numbers[:1])


def corners_of(bounds: arrays.Bounds) -> Corners:
    """Return four corners of the box of poses within bounds."""
    (x, y, turn), (far_x, far_y, far_turn) = bounds
    return (x, y, turn), (x, far_y, turn), (far_x, y, turn), (far_x, far_y, far_turn)


# ---- bounds of many poses: a GPU reads a million in hundredths of a millisecond, the host's threads in one


def bounds_poses(backend: Backend) -> bool:
    """Return whether a device bounds poses faster than the host."""
    return backend.info.kind == "gpu" and backend.info.float64


def bounds_on_device(backend: Backend, space: Workspace, poses: Buffer, count: int, *, single: bool = False) -> Bounds:
    """Return the least and the largest x, y and theta of ``count`` poses, not 0; NaN for a column with NaN."""
    program: Program = ()
    flags = flags_if(POSES_FLOAT32=single)
    number, numbers, apart = poses, 3 * count, 0
    for items in _ITEMS:
        found = space.empty(f"bounds of {items}", 2 * items, _DOUBLE)
        program += (
            launch(
                "bound_numbers", flags, (items,), number=number, bounds=found, count=numbers, apart=apart, items=items
            ),
        )  # fmt: skip
        number, numbers, apart, flags = found, items, items, frozenset()
    backend.run(program)
    halves = np.empty((2, _ITEMS[-1] // 3, 3))
    space.read(number, halves)
    return tuple(halves[0].min(axis=0).tolist()), tuple(halves[1].max(axis=0).tolist())
