"""Moving shapes of many worlds: discs, boxes and segments, on a device."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from gpusense._util import checks
from gpusense.backends import Backend, arrays
from gpusense.backends.base import Buffer
from gpusense.interface.flags import flags_if
from gpusense.interface.launches import launch
from gpusense.interface.structs import Crowd, Frame
from gpusense.reference.shapes import DIRECTIONS, turned

# By kind: numbers of a shape as the user passes it, and in the table.
_KINDS = {"discs": (3, 4), "boxes": (5, 8), "segments": (4, 4)}


@dataclass(frozen=True, eq=False)
class Shapes:
    """Shapes that move in many worlds, which rays meet like walls.

    Args:
        discs: (M, D, 3) x, y and radius of D discs in each of M worlds [m].
        boxes: (M, B, 5) x, y, theta, length along theta and width [m, m, rad, m, m].
        segments: (M, G, 4) x and y of both ends [m].

    Arrays may be on the device of the worlds. A row with a number that is not finite or beyond 1e6, or with a negative
    size, is no shape. Shapes are numbered from 0 in each world: discs, then boxes, then segments.

    Raises:
        TypeError, ValueError: An array in host memory does not hold real numbers, or has another shape.

    Example:
        >>> import gpusense as gs
        >>> gs.Shapes(discs=[[[1.0, 2.0, 0.3]]])
        Shapes(1 disc in each of 1 world)
    """

    discs: Any = None
    boxes: Any = None
    segments: Any = None

    def __post_init__(self) -> None:
        counts = set()
        for name, (numbers, _) in _KINDS.items():
            given = getattr(self, name)
            if given is None:
                continue
            if not arrays.on_device(given):
                given = checks.array(name, arrays.to_host(given, name), ("M", "N", numbers), finite=False)
                object.__setattr__(self, name, np.ascontiguousarray(given))
            shape = tuple(given.shape)
            if len(shape) != 3 or shape[2] != numbers:
                raise ValueError(f"{name}: shape must be (M, N, {numbers}), got {checks.shape_text(shape)}")
            counts.add(shape[0])
        if len(counts) > 1:
            raise ValueError(f"discs, boxes, segments: must be of the same number of worlds, got {sorted(counts)}")

    def counts(self) -> tuple[int, int, int]:
        """Return the numbers of discs, boxes and segments of each world."""
        discs, boxes, segments = (0 if (kind := getattr(self, name)) is None else int(kind.shape[1]) for name in _KINDS)
        return discs, boxes, segments

    @property
    def worlds(self) -> int | None:
        """Number of worlds; None without shapes."""
        return next((int(kind.shape[0]) for name in _KINDS if (kind := getattr(self, name)) is not None), None)

    def __repr__(self) -> str:
        words = []
        for (one, many), count in zip((("disc", "discs"), ("box", "boxes"), ("segment", "segments")), self.counts(),
                                      strict=True):  # fmt: skip
            words += [f"{count} {one if count == 1 else many}"] if count else []
        worlds = self.worlds or 0
        return f"Shapes({', '.join(words) or 'none'} in each of {worlds} world{'s' if worlds != 1 else ''})"


def turns_of(vectors: np.ndarray) -> np.ndarray:
    """Return the order of (K, 2) ray vectors by direction; see the kernel file ``shapes``.

    Returns:
        (4097 + K,) first place of each range of directions among the rays in order, K, and the rays in order.
    """
    x, y = vectors.T
    places = np.floor(turned(x, y) * (DIRECTIONS / 4)).astype(int) % DIRECTIONS
    order = np.argsort(places, kind="stable")
    firsts = np.searchsorted(places[order], np.arange(DIRECTIONS + 1))
    return np.concatenate([firsts, order]).astype(np.int32)


NO_CROWD = Crowd(0, 0, 0, 0, 0.0)


class CrowdTable:
    """The shapes of all worlds on a device, in the cells of their grids, in a precision each."""

    def __init__(self, backend: Backend, frames: Buffer, resolution: float, worlds: int) -> None:
        self._backend, self._frames, self._resolution, self._worlds = backend, frames, resolution, worlds
        self._shapes = Shapes()
        self._tables: dict[np.dtype, Buffer] = {}
        self.crowd, self.version = NO_CROWD, 0

    @property
    def shapes(self) -> Shapes:
        """The shapes as they were assigned."""
        return self._shapes

    def assign(self, shapes: Shapes) -> None:
        """Replace all shapes; buffers stay where the numbers of shapes are unchanged."""
        checks.instance("shapes", shapes, Shapes)
        if shapes.worlds not in (None, self._worlds):
            raise ValueError(f"shapes: must be of {self._worlds} worlds, got {shapes.worlds}")
        discs, boxes, segments = shapes.counts()
        # The reference tests every shape.
        pairs = 0 if self._backend.info.backend == "numpy" else -(-(discs + boxes + segments) // 64)
        crowd = Crowd(discs, boxes, segments, 4 * discs + 8 * boxes + 4 * segments, self._resolution, pairs)
        tables = self._tables
        if crowd != self.crowd:
            reals = tables or {np.dtype(np.float32): None}
            tables = {real: self._backend.empty(max(self._worlds * crowd.stride, 1), real) for real in reals}
        for real, table in tables.items():
            self._fill(shapes, crowd, table, real)
        self._backend.synchronize()
        if crowd != self.crowd:
            self.version += 1
        self._shapes, self._tables, self.crowd = shapes, tables, crowd

    def table(self, real: np.dtype) -> Buffer:
        """Return the numbers of all shapes in a precision."""
        if real not in self._tables:
            table = self._backend.empty(max(self._worlds * self.crowd.stride, 1), real)
            self._fill(self._shapes, self.crowd, table, real)
            self._backend.synchronize()
            self._tables[real] = table
        return self._tables[real]

    def _fill(self, shapes: Shapes, crowd: Crowd, table: Buffer, real: np.dtype) -> None:
        begin = 0
        for (name, (numbers, each)), count in zip(_KINDS.items(), shapes.counts(), strict=True):
            if not count:
                continue
            raw, single = self._raw(name, getattr(shapes, name))
            frame = Frame(0.0, 0.0, self._resolution, 0.0, 0.0, 1.0, 0.0)
            flags = flags_if(FLOAT64=real == np.float64, POSES_FLOAT32=single, HUGE_HEADINGS=True)
            self._backend.run((
                launch(
                    "place_shapes", flags, (count, self._worlds), raw=raw, frames=self._frames, shapes=table,
                    frame=frame, count=count, numbers=numbers, begin=begin, stride=crowd.stride, worlds=self._worlds,
                ),
            ))  # fmt: skip
            begin += count * each

    def _raw(self, name: str, given: Any) -> tuple[Buffer, bool]:
        """Return shapes of a kind on the device, and whether they are float32 numbers."""
        if not arrays.on_device(given):
            return self._backend.upload(np.ascontiguousarray(given, np.float64)), False
        adopted = arrays.adopt_numbers(given, self._backend, name)
        return adopted.buffer, adopted.dtype == np.float32
