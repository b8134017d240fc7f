"""The worlds of a request's poses: checks of indices, placement of poses in their worlds, and collisions."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np

from gpusense._util import checks
from gpusense.backends import Backend, arrays
from gpusense.backends.base import Buffer
from gpusense.backends.workspace import Workspace
from gpusense.interface.flags import flags_if
from gpusense.interface.launches import launch
from gpusense.interface.structs import Crowd, Frame
from gpusense.reference.shapes import SIGHTS
from gpusense.tables.crowd import CrowdTable
from gpusense.world.windows import LONGEST_SIDE

_INT, _BYTE, _SINGLE = np.dtype(np.int32), np.dtype(np.uint8), np.dtype(np.float32)
_ON_DEVICE = ("int32", "int64")


class ManyWorlds(Protocol):
    """The worlds, as this module uses them."""

    backend: Backend
    space: Workspace
    store: Buffer
    frames: Buffer
    crowd: CrowdTable
    threshold: int
    uniform: bool

    @property
    def resolution(self) -> float:
        """Side of a cell [m]."""

    def __len__(self) -> int: ...


class WorldIndex:
    """The world of each pose, and the shape that the pose does not see, or -1; one for all poses, or None."""

    def __init__(self, worlds: ManyWorlds, world: Any, ignore: Any, count: int, backend: Backend) -> None:
        self.worlds = worlds
        if world is None:
            if len(worlds) > 1:
                raise ValueError(f"world: must be an index of one of {len(worlds)} worlds for each pose, got None")
            world = 0
        self._world = _indices("world", world, count, backend, 0, len(worlds))
        crowd = worlds.crowd.crowd
        shapes = crowd.discs + crowd.boxes + crowd.segments
        self._ignore = None if ignore is None else _indices("ignore", ignore, count, backend, -1, shapes)

    def resident(self, backend: Backend) -> WorldIndex:
        """Return the same indices on the device, for calls that repeat them."""
        for name in ("_world", "_ignore"):
            value = getattr(self, name)
            if isinstance(value, np.ndarray):
                setattr(self, name, backend.view(backend.upload(value), value.shape, value.dtype))
        return self

    @property
    def sights(self) -> int:
        """Numbers of the sights of a pose that casts rays; see the kernel file ``shapes``."""
        return 2 * SIGHTS * self.worlds.crowd.crowd.pairs

    def buffers(self, backend: Backend, space: Workspace, part: tuple[int, int], *, sees: bool = False) -> InWorlds:
        """Return the indices of some poses on the device, which need sights if they cast rays."""
        worlds, crowd = self.worlds, self.worlds.crowd.crowd
        index, wide = _buffer("world", self._world, backend, space, part)
        ignore, wide_ignore = index, wide
        if crowd.stride:
            ignored = np.full(part[1], -1, _INT) if self._ignore is None else self._ignore
            ignore, wide_ignore = _buffer("ignore", ignored, backend, space, part)
        return InWorlds(worlds, index, ignore, wide, wide_ignore, self.sights if sees else 0)


class InWorlds(NamedTuple):
    """Worlds of some poses on the device."""

    worlds: ManyWorlds
    index: Buffer  # index of the world of each pose
    ignore: Buffer  # index of the shape that each pose does not see; not read without shapes
    wide: int  # numbers of 32 bits of each index of a world
    wide_ignore: int  # the same of each index of a shape
    sights: int = 0  # numbers of the sights of each pose

    @property
    def crowd(self) -> Crowd:
        """The numbers of shapes."""
        return self.worlds.crowd.crowd

    def crowd_of(self, count: int) -> Crowd:
        """Return the numbers of shapes for launches of ``count`` poses, whose sights follow their worlds."""
        return self.crowd._replace(begin=2 * count)

    @property
    def flags(self) -> frozenset[str]:
        """Flags of kernels that cast rays of these poses."""
        return flags_if(WORLDS=True, SHAPES=self.crowd.stride > 0)


def _indices(name: str, value: Any, count: int, backend: Backend, low: int, size: int) -> Any:
    """Return (N,) indices from ``low`` to ``size`` - 1 as int32 in host memory, or as an array on the device."""
    if type(value) is not np.ndarray and arrays.on_device(value):
        adopted = arrays.adopt_integers(value, backend, name, _ON_DEVICE)
        if adopted.shape != (count,):
            raise ValueError(f"{name}: shape must be ({count},), got {checks.shape_text(adopted.shape)}")
        return adopted
    read = checks.as_array(name, arrays.to_host(value, name))
    if isinstance(value, (list, tuple)) and not value:
        read = read.astype(int)
    if read.dtype.kind not in "iu":
        cure = "numpy.flatnonzero(mask)" if read.dtype.kind == "b" else f"{name}.astype(int)"
        raise TypeError(f"{name}: must hold integers, got dtype {read.dtype}; pass {cure}")
    shape = () if read.ndim == 0 else (count,)
    if read.shape != shape:
        raise ValueError(f"{name}: shape must be ({count},), got {checks.shape_text(read.shape)}")
    read = checks.indices(name, np.atleast_1d(read), size, low=low)
    return np.ascontiguousarray(np.broadcast_to(read, (count,)), _INT)


def _buffer(name: str, given: Any, backend: Backend, space: Workspace, part: tuple[int, int]) -> tuple[Buffer, int]:
    """Return some indices on the device, and the numbers of 32 bits of each."""
    begin, end = part
    if isinstance(given, np.ndarray):
        return space.upload(f"{name} index", given[begin:end]), 1
    wide = given.dtype.itemsize // 4
    if begin * wide * 4 % backend.alignment == 0:
        return backend.part(given.buffer, begin * wide, (end - begin) * wide, _INT), wide
    copied = space.empty(f"{name} part", (end - begin) * wide, _INT)
    backend.copy(given.buffer, copied, 4 * (end - begin) * wide, begin=4 * begin * wide)
    return copied, wide


def collisions(worlds: ManyWorlds, poses: Any, radius: object, world: Any, ignore: Any, unknown: str) -> Any:
    """Return which discs about poses meet an obstacle or a shape; see ``Worlds.collides``."""
    # A larger disc covers every world.
    cells = min(checks.real("radius", radius, low=0) / worlds.resolution, 4.0 * LONGEST_SIDE)
    checks.choice("unknown", unknown, ("free", "occupied"))
    backend, single, there = worlds.backend, False, arrays.on_device(poses)
    if there:
        buffer, count, single, _ = arrays.adopt_poses(poses, backend, "poses")
    else:
        host = checks.array("poses", arrays.host_poses(poses, "poses"), ("N", 3))
        buffer, count = backend.upload(host), len(host)
    inside = WorldIndex(worlds, world, ignore, count, backend).buffers(backend, worlds.space, (0, count))
    hit = backend.empty_external(count, _BYTE) if there else backend.empty(count, _BYTE)
    if count:
        _collide(worlds, buffer, count, inside, hit, cells, single=single, unknown=unknown == "occupied")
    if there:
        return arrays.wrapped(poses, backend, hit, (count,), _BYTE)
    return arrays.like(poses, backend.download(hit, np.empty(count, np.uint8)).view(bool))


def _collide(
    worlds: ManyWorlds, poses: Buffer, count: int, inside: InWorlds, hit: Buffer, radius: float, *, single: bool,
    unknown: bool,
) -> None:  # fmt: skip
    """Place poses, and find the discs about them, with a radius in cells, that meet anything."""
    space, backend = worlds.space, worlds.backend
    cell, pose = space.empty("cell", 2 * count, _INT), space.empty("pose", 4 * count, _SINGLE)
    placed, status = space.empty("placed", 4 * count, _INT), backend.upload(np.zeros(2, _INT))
    crowd = dict(shapes=worlds.crowd.table(_SINGLE), crowd=inside.crowd)
    flags = inside.flags | flags_if(POSES_FLOAT32=single, HUGE_HEADINGS=True)
    backend.run((
        launch(
            "place_in_worlds", flags, (count,), poses=poses, index=inside.index, ignore=inside.ignore,
            frames=worlds.frames, pose_cell=cell, pose=pose, pose_low=space.empty("low", 4, _SINGLE), world=placed,
            pose_status=status, frame=Frame(0.0, 0.0, worlds.resolution, 0.0, 0.0, 1.0, 0.0), particles=count,
            worlds=len(worlds), wide=inside.wide, wide_ignore=inside.wide_ignore, **crowd,
        ),
        launch(
            "find_collisions", inside.flags, (count,), store=worlds.store, world=placed, **crowd, pose_cell=cell,
            pose=pose, hit=hit, particles=count, radius=radius, threshold=worlds.threshold, unknown=int(unknown),
        ),
    ))  # fmt: skip
    state = backend.download(status, np.zeros(2, _INT))
    space.wait()
    if state[0] > 1:
        raise ValueError("world: every index must be one of the worlds, got an index on the device that is not")
    if state[0]:
        raise ValueError("poses: must be finite, got a pose on the device that is not")
