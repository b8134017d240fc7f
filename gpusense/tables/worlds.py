"""Many maps in one buffer of a device, and tables that are made of them for all worlds at once."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Hashable, Iterator
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from gpusense._util import checks
from gpusense._util.typing import Space
from gpusense.backends import Backend, BackendInfo, Selection, arrays, get_backend
from gpusense.backends.base import Adopted, Buffer
from gpusense.backends.workspace import Workspace
from gpusense.interface.launches import launch
from gpusense.tables.crowd import CrowdTable, Shapes
from gpusense.tables.world_cells import Stack, Table, are_grids, checked_cells, checked_origins, frames_of, of_grids
from gpusense.tables.world_index import collisions
from gpusense.world.grid import OccupancyGrid, check_resolution

_INT, _BYTE = np.dtype(np.int32), np.dtype(np.uint8)
_NO_FLAGS: frozenset[str] = frozenset()
# Cells around a world in tables, on each side.
RING = 2
# Padded cells of all worlds, which kernels count in 32 bits.
_MOST_CELLS = (1 << 31) - 1
# Worlds begin at multiples of this number of cells.
_WHOLE = 512
# Cells of worlds that are made at once, by kind of device: they bound the memory besides the tables.
_TOGETHER = {"cpu": 1 << 22, "gpu": 1 << 26}


class Worlds:
    """M maps in one buffer of a device, for robots in all of them.

    ``RayCaster``, ``BeamModel`` and ``LikelihoodFieldModel`` take worlds in place of a grid; their calls then take
    ``world=``, the index of the map of each pose. Results have the bits of models of the single maps.

    Args:
        cells: (M, H, W) integers as :class:`OccupancyGrid` takes them, an int8 array on the device (its values are not
            inspected), or a list of grids, or of (H, W) cells, of any sizes.
        resolution: Side of a cell [m], of all worlds; of grids their resolution by default, else 0.05.
        origin: Pose (x, y, yaw) of the outer corner of the first cell of all worlds, or (M, 3) poses [m, m, rad]; of
            grids their origins by default.
        backend: The device, see :func:`gpusense.devices`.
        occupied_threshold: Least occupancy of an occupied cell [per cent]; of grids their threshold by
            default, else 65.

    Raises:
        TypeError: An argument has the wrong type, such as cells of dtype float or bool.
        ValueError: A shape or a value breaks a rule above, or grids differ in their resolution or threshold.
        MemoryError: The device does not hold the worlds; the message says how many fit.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> cells = 100 * np.eye(8, dtype=np.int8)[[5, 7], None]
        >>> worlds = gs.Worlds(cells, resolution=0.5, backend="numpy")
        >>> worlds
        Worlds(2 of 1 x 8 cells, resolution=0.5, backend='numpy', 1.02 kB, 1 bytes a cell)
        >>> caster = gs.RayCaster(worlds, range_max=5.0, backend="numpy")
        >>> caster.cast([(0.25, 0.25, 0.0), (0.25, 0.25, 0.0)], [0.0], world=[0, 1]).tolist()
        [[2.25], [3.25]]
    """

    def __init__(
        self,
        cells: Any,
        resolution: float | None = None,
        origin: ArrayLike | None = None,
        *,
        backend: Selection = "auto",
        occupied_threshold: int | None = None,
    ) -> None:
        self.backend: Backend = get_backend(backend)
        self._asked = backend if isinstance(backend, str) else self.backend.info.selection
        if are_grids(cells):
            resolution, origin, occupied_threshold = of_grids(cells, resolution, origin, occupied_threshold)
            cells = [grid.cells for grid in cells]
        self._resolution = check_resolution(0.05 if resolution is None else resolution)
        threshold = 65 if occupied_threshold is None else occupied_threshold
        self.threshold = checks.integer("occupied_threshold", threshold, low=1, high=100)
        given, self._sizes = checked_cells(cells, self.backend, "cells")
        count = len(self._sizes)
        self._origins = checked_origins(origin, count)
        # Parts of buffers begin at multiples of some bytes.
        whole = max(_WHOLE, self.backend.alignment)
        rows, cols = self._sizes.T
        # Planes of rectangles have whole groups of 8 rows on GPUs.
        padded = np.maximum((rows + 2 * RING) * (cols + 2 * RING), (rows + 9) // 8 * 8 * (cols + 2))
        padded = -(-padded // whole) * whole
        self._total = int(padded.sum())
        if self._total > _MOST_CELLS:
            raise MemoryError(
                f"cells: must have at most {_MOST_CELLS} cells in all, with 2 around each world, got {self._total}; "
                f"{int(np.searchsorted(np.cumsum(padded), _MOST_CELLS, side='right'))} of {count} worlds fit"
            )
        self._place = np.append(0, np.cumsum(padded)[:-1]).astype(np.int32)
        self.space = Workspace(self.backend)
        self._tables: dict[Hashable, Table] = {}
        self.maps: weakref.WeakSet[Any] = weakref.WeakSet()  # maps of models, whose versions follow the shapes
        self.store = self.allocate(1, _BYTE)
        self.frames = self.backend.upload(frames_of(self._origins, self._resolution, self._sizes, self._place))
        self.crowd = CrowdTable(self.backend, self.frames, self._resolution, count)
        self._put(np.arange(count), given)
        # Worlds of one size are of one kind.
        self._kind = np.unique(self._sizes, axis=0, return_inverse=True)[1].reshape(-1)
        self.uniform = not self._kind.any() and all(pose == self._origins[0] for pose in self._origins)

    def __len__(self) -> int:
        return len(self._sizes)

    @property
    def resolution(self) -> float:
        """Side of a cell [m]."""
        return self._resolution

    @property
    def origin(self) -> tuple[float, float, float]:
        """Pose of the first world's outer corner [m, m, rad]."""
        return self._origins[0]

    @property
    def origins(self) -> np.ndarray:
        """(M, 3) poses of the outer corners of the worlds' first cells [m, m, rad]."""
        return np.array(self._origins)

    @property
    def sizes(self) -> np.ndarray:
        """(M, 2) rows and columns."""
        return self._sizes.copy()

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the largest world along each axis."""
        rows, cols = self._sizes.max(axis=0).tolist()
        return rows, cols

    @property
    def width(self) -> float:
        """Extent of the widest world along its columns [m]."""
        return self.shape[1] * self._resolution

    @property
    def height(self) -> float:
        """Extent of the highest world along its rows [m]."""
        return self.shape[0] * self._resolution

    @property
    def device(self) -> BackendInfo:
        """The device that holds the worlds."""
        return self.backend.info

    @property
    def cells(self) -> int:
        """Number of cells of all worlds, with two around each."""
        return self._total

    @property
    def nbytes(self) -> int:
        """Bytes on the device: cells, and the tables that models have made so far."""
        return self._total + sum(table.size for table in self._tables.values())

    def __repr__(self) -> str:
        rows, cols = self.shape
        size = f"up to {rows} x {cols}" if self._kind.any() else f"{rows} x {cols}"
        shapes = "" if self.shapes.worlds is None else f", shapes={self.shapes}"
        power = min(max(len(str(self.nbytes)) - 1, 0) // 3, 3)
        memory = f"{self.nbytes / 1000**power:.3g} {('bytes', 'kB', 'MB', 'GB')[power]}"
        return (
            f"Worlds({len(self)} of {size} cells, resolution={self._resolution}{shapes}, "
            f"backend={self.device.selection!r}, {memory}, {self.nbytes / self._total:g} bytes a cell)"
        )

    def __reduce__(self) -> tuple[Any, ...]:
        # Copies and pickles call the constructor: buffers of a device do not travel.
        cells = [self.grid(number).cells for number in range(len(self))]
        make = partial(Worlds, backend=self._asked, occupied_threshold=self.threshold)
        return make, (cells, self._resolution, self.origins), self.shapes

    def __setstate__(self, shapes: Shapes) -> None:
        self.shapes = shapes

    def grid(self, index: int) -> OccupancyGrid:
        """Return one world as a map in host memory."""
        number = checks.integer("index", index, low=0, high=len(self) - 1)
        (rows, cols), first = self._sizes[number].tolist(), int(self._place[number])
        cells = np.empty(rows * cols, np.int8)
        self.backend.download(self.backend.part(self.store, first, rows * cols, _BYTE), cells.view(_BYTE))
        return OccupancyGrid(
            cells.reshape(rows, cols), self._resolution, self._origins[number], occupied_threshold=self.threshold
        )

    @property
    def shapes(self) -> Shapes:
        """The moving shapes. Shapes of the same numbers are moved in place: models and bound calls see them at once."""
        return self.crowd.shapes

    @shapes.setter
    def shapes(self, shapes: Shapes) -> None:
        version = self.crowd.version
        self.crowd.assign(shapes)
        if self.crowd.version != version:
            for one in self.maps:
                one.version += 1

    def replace(self, index: ArrayLike, cells: Any) -> None:
        """Replace the cells of some worlds, and make their tables again on the device.

        Args:
            index: (I,) indices of the worlds.
            cells: Their cells, as for the constructor, of the sizes that they had; of grids, their resolution, origin
                and threshold must be those of the worlds.

        Raises:
            TypeError, ValueError: An argument breaks a rule, or an index occurs twice; nothing has changed.
        """
        read: Any = arrays.copied_to_host(index, self.backend, "index")
        which = checks.indices("index", read, len(self), ("I",))
        if len(np.unique(which)) < len(which):
            raise ValueError(f"index: every world must occur once, got {checks.show(read)}")
        if not len(which):
            return
        grids = cells if are_grids(cells) else ()
        if grids:
            of_grids(grids, self._resolution, None, self.threshold)
            cells = [grid.cells for grid in grids]
        given, sizes = checked_cells(cells, self.backend, "cells")
        if len(sizes) != len(which) or (sizes != self._sizes[which]).any():
            wanted, found = self._sizes[which].tolist(), sizes.tolist()
            raise ValueError(f"cells: sizes must be those of the worlds, {wanted[:3]} ..., got {found[:3]} ...")
        for number, grid in enumerate(grids):
            origin = self._origins[which[number]]
            if grid.origin != origin:
                raise ValueError(f"cells[{number}]: origin must be {origin}, got {grid.origin}")
        self._put(which, given)
        for stack in self.stacks(which):
            for table in self._tables.values():
                table.fill(stack, table.buffer)
        self.space.wait()

    def collides(
        self, poses: Any, radius: float, *, world: Any = None, ignore: Any = None, unknown: Space = "free"
    ) -> Any:
        """Return which discs around poses touch an obstacle or a moving shape.

        Contact with the squares of occupied cells and with shapes is exact, up to float32 rounding in cells. Space
        outside a world is free.

        Args:
            poses: (N, 3) poses (x, y, theta) in the world [m, m, rad], an array as ``RayCaster.cast`` takes it.
            radius: Radius of the discs [m], >= 0.
            world: (N,) indices of the poses' worlds, or one for all; optional with a single world.
            ignore: (N,) index of the shape that each disc ignores, or one for all; -1 for none. Arrays on the device
                are not inspected.
            unknown: Treatment of unknown cells: ``"free"`` or ``"occupied"``.

        Returns:
            (N,) bool, an array of the library of the poses; for poses on the device it holds 0 and 1.

        Raises:
            TypeError, ValueError: An argument breaks a rule above, or a pose is not finite.

        Example:
            >>> import gpusense as gs, numpy as np
            >>> cells = np.zeros((1, 4, 4), np.int8)
            >>> cells[0, 0, 3] = 100
            >>> worlds = gs.Worlds(cells, resolution=1.0, backend="numpy")
            >>> worlds.collides([(2.2, 0.5, 0.0), (2.7, 0.5, 0.0)], radius=0.5).tolist()
            [False, True]
        """
        return collisions(self, poses, radius, world, ignore, unknown)

    def table(self, key: Hashable, make: Callable[[], Table]) -> Table:
        """Return a table of all worlds, which models share.

        ``key``: all on which it depends, except the cells; ``make``: function that returns it before it is filled.
        """
        if key not in self._tables:
            table = make()
            for stack in self.stacks(np.arange(len(self))):
                table.fill(stack, table.buffer)
                self.backend.synchronize()
            self.space.release()
            self._tables[key] = table
        return self._tables[key]

    @property
    def largest_table(self) -> int:
        """Largest size of a table of all worlds [bytes]."""
        numbers = 8 * _MOST_CELLS if self.device.backend == "warp" else self.device.max_buffer
        return min(self.device.max_buffer, numbers)

    def allocate(self, each: int, dtype: np.dtype) -> Buffer:
        """Return a buffer for ``each`` numbers of each cell of all worlds, or say how many worlds fit."""
        info, size = self.backend.info, self._total * each * dtype.itemsize
        try:
            if size > self.largest_table:
                raise MemoryError
            count = self._total * each
            if count <= _MOST_CELLS or info.backend != "warp":
                return self.backend.empty(count, dtype, zero=True)
            # An array of Warp has fewer numbers; kernels add the offset of a world to its address.
            whole = self.backend.empty(-(-size // 8), np.dtype(np.float64), zero=True)
            return self.backend.part(whole, 0, _MOST_CELLS, dtype)
        except MemoryError as error:
            room = self.largest_table if size > self.largest_table else info.memory // 2
            ends = np.cumsum(np.append(self._place[1:], self._total) - self._place, dtype=np.int64)
            fit = int(np.searchsorted(ends * each * dtype.itemsize, room, side="right"))
            raise MemoryError(
                f"cells: must fit into the memory of {info.name}: {fit} of {len(self)} worlds of "
                f"{each * dtype.itemsize} bytes a cell fit, got {size / 1e9:.1f} GB in all"
            ) from error

    def stacks(self, indices: np.ndarray) -> Iterator[Stack]:
        """Yield stacks of worlds of one size, of as many cells as are made at once."""
        kinds = self._kind[indices]
        for kind in np.unique(kinds).tolist():
            members = indices[kinds == kind]
            rows, cols = self._sizes[members[0]].tolist()
            each = max(_TOGETHER[self.backend.info.kind] // (rows * cols), 1)
            for first in range(0, len(members), each):
                part = members[first : first + each]
                yield Stack(part, rows, cols, self._places(part), self.space)

    def marked(self, stack: Stack, unknown: str, margin: int = 0) -> tuple[Buffer, tuple[int, int]]:
        """Return the obstacles of a stack, with a margin of obstacles around each world, and the size of each.

        They are bytes on a processor, else bits.
        """
        rows, cols, as_bits = stack.rows + 2 * margin, stack.cols + 2 * margin, self.device.kind == "gpu"
        lines, words = rows * stack.worlds, -(-cols // 32)
        occupied = stack.space.empty("occupied", 1 if as_bits else lines * cols, _BYTE)
        bits = stack.space.empty("bits", lines * words if as_bits else 1, _INT)
        self._run(
            "mark_obstacles", (words * lines,), store=self.store, place=stack.place, occupied=occupied, bits=bits,
            rows=stack.rows, cols=stack.cols, worlds=stack.worlds, words=words, margin=margin,
            threshold=self.threshold, unknown=int(unknown == "occupied"), as_bits=int(as_bits),
        )  # fmt: skip
        return bits if as_bits else occupied, (rows, cols)

    def put(self, index: int, table: Buffer, numbers: np.ndarray, each: int) -> None:
        """Copy numbers from host memory to a world's part of a table with ``each`` numbers of a cell."""
        first = int(self._place[index]) * each
        self.backend.upload(numbers.reshape(-1), self.backend.part(table, first, numbers.size, numbers.dtype))

    def _put(self, indices: np.ndarray, given: Any) -> None:
        """Copy the cells of some worlds to the device."""
        if isinstance(given, list):
            for index, cells in zip(indices, given, strict=True):
                self._put(np.array([index]), cells[None])
            return
        count = int(np.prod(given.shape[1:]))
        # Warp tells bytes with and without a sign apart.
        whole = isinstance(given, Adopted)
        buffer = self.backend.part(given.buffer, 0, count * len(indices), _BYTE) if whole else None
        # A work-item copies 16 cells: one each took six times as long on a GPU.
        items = -(-count // 16)
        step = len(indices) if buffer is not None else max((1 << 28) // count, 1)
        for first in range(0, len(indices), step):
            part = indices[first : first + step]
            cells = buffer
            if buffer is None:
                cells = self.backend.upload(np.ascontiguousarray(given[first : first + step]).view(_BYTE))
            self._run(
                "put_cells", (items, len(part)), cells=cells, place=self._places(part), store=self.store, count=count,
                worlds=len(part), items=items,
            )  # fmt: skip
            if first + step < len(indices):
                self.backend.synchronize()

    def _places(self, indices: np.ndarray) -> Buffer:
        """Return the first cells of some worlds in tables, on the device."""
        return self.space.hold("place", indices.tobytes(), lambda: self._place[indices])

    def _run(self, kernel: str, size: tuple[int, ...], **arguments: Any) -> None:
        self.backend.run((launch(kernel, _NO_FLAGS, size, **arguments),))
