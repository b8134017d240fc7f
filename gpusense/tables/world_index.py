"""The worlds of a request's poses: checks of indices, and placement of poses in their worlds."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np

from gpusense._util import checks
from gpusense.backends import Backend, arrays
from gpusense.backends.base import Buffer
from gpusense.backends.workspace import Workspace
from gpusense.interface.flags import flags_if
from gpusense.interface.structs import Crowd
from gpusense.tables.crowd import CrowdTable

_INT = np.dtype(np.int32)
# The kernel file ``shapes`` has the same number.
SIGHTS = 64
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
    """The world of each pose, and the shape that the pose does not see.

    ``world``: (N,) indices of worlds, or one for all poses; None with a single world; ``ignore``: (N,) indices of
    shapes, -1 for none, or one for all poses; None ignores none.
    """

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
