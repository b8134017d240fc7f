"""Many maps in one buffer of a device, and tables that are made of them for all worlds at once."""

from __future__ import annotations

import math
import weakref
from collections.abc import Callable, Hashable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from gpusense._util import checks
from gpusense._util.typing import Space
from gpusense.backends import Backend, BackendInfo, Selection, arrays, get_backend
from gpusense.backends.base import Adopted, Buffer
from gpusense.backends.workspace import Workspace
from gpusense.interface.flags import flags_if
from gpusense.interface.launches import launch
from gpusense.interface.structs import Frame
from gpusense.tables.crowd import CrowdTable, Shapes
from gpusense.world.frames import frame_of
from gpusense.world.grid import OccupancyGrid
from gpusense.world.grid_frame import check_resolution
from gpusense.world.windows import LONGEST_SIDE, Window

if TYPE_CHECKING:
    from gpusense.tables.world_index import InWorlds

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


class Stack(NamedTuple):
    """Some worlds of one size whose tables are made together.

    Attributes:
        indices: (W,) indices of the worlds.
        rows: Rows of each.
        cols: Columns of each.
        place: First cell of each in tables with a ring, on the device.
        space: Memory besides the tables.
    """

    indices: np.ndarray
    rows: int
    cols: int
    place: Buffer
    space: Workspace

    @property
    def worlds(self) -> int:
        """W."""
        return len(self.indices)


class Table(NamedTuple):
    """A table of all worlds.

    Attributes:
        buffer: The table.
        size: Its size [bytes].
        fill: Function that fills the parts of a stack of worlds.
    """

    buffer: Buffer
    size: int
    fill: Callable[[Stack, Buffer], None]


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
        grids = cells if isinstance(cells, (list, tuple)) and any(isinstance(c, OccupancyGrid) for c in cells) else None
        if grids is not None:
            resolution, origin, occupied_threshold = _of_grids(grids, resolution, origin, occupied_threshold)
            cells = [grid.cells for grid in grids]
        self._resolution = check_resolution(0.05 if resolution is None else resolution)
        threshold = 65 if occupied_threshold is None else occupied_threshold
        self._threshold = checks.integer("occupied_threshold", threshold, low=1, high=100)
        given, self._sizes = _checked_cells(cells, self.backend, "cells")
        count = len(self._sizes)
        self._origins = _checked_origins(origin, count)
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
        self._space = Workspace(self.backend)
        self._tables: dict[Hashable, Table] = {}
        self._maps: weakref.WeakSet[WorldMap] = weakref.WeakSet()
        self._store = self.allocate(1, _BYTE)
        self.frames = self.backend.upload(self._frames())
        self.crowd = CrowdTable(self.backend, self.frames, self._resolution, count)
        self._put(np.arange(count), given)
        sizes = self._sizes
        self.uniform = bool((sizes == sizes[0]).all() and all(pose == self._origins[0] for pose in self._origins))

    # ---- what worlds are

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
        size = f"{rows} x {cols}" if (self._sizes == self._sizes[0]).all() else f"up to {rows} x {cols}"
        shapes = "" if self.shapes.worlds is None else f", shapes={self.shapes}"
        power = min(max(len(str(self.nbytes)) - 1, 0) // 3, 3)
        memory = f"{self.nbytes / 1000**power:.3g} {('bytes', 'kB', 'MB', 'GB')[power]}"
        return (
            f"Worlds({len(self)} of {size} cells, resolution={self._resolution}{shapes}, "
            f"backend={self.device.selection!r}, {memory}, {self.nbytes / self._total:g} bytes a cell)"
        )

    def grid(self, index: int) -> OccupancyGrid:
        """Return one world as a map in host memory.

        Raises:
            TypeError, ValueError: No index of a world.
        """
        number = checks.integer("index", index, low=0, high=len(self) - 1)
        (rows, cols), first = self._sizes[number].tolist(), int(self._place[number])
        cells = np.empty(rows * cols, np.int8)
        self.backend.download(self.backend.part(self._store, first, rows * cols, _BYTE), cells.view(_BYTE))
        return OccupancyGrid(
            cells.reshape(rows, cols), self._resolution, self._origins[number], occupied_threshold=self._threshold
        )

    def obstacles(self, index: int, unknown: str) -> np.ndarray:
        """Return the (H, W) mask of a world's cells that stop a beam."""
        return self.grid(index).obstacles("occupied" if unknown == "occupied" else "free")

    # ---- changes

    @property
    def shapes(self) -> Shapes:
        """The moving shapes. Shapes of the same numbers are moved in place: models and bound calls see them at once."""
        return self.crowd.shapes

    @shapes.setter
    def shapes(self, shapes: Shapes) -> None:
        version = self.crowd.version
        self.crowd.assign(shapes)
        if self.crowd.version != version:
            for one in self._maps:
                one.version += 1

    def replace(self, index: ArrayLike, cells: Any) -> None:
        """Replace the cells of some worlds, and make their tables again on the device.

        Args:
            index: (I,) indices of the worlds.
            cells: Their cells, as for the constructor, of the sizes that they had.

        Raises:
            TypeError, ValueError: An argument breaks a rule, or an index occurs twice; nothing has changed.
        """
        read: Any = arrays.copied_to_host(index, self.backend, "index")
        which = checks.indices("index", read, len(self), ("I",))
        if len(np.unique(which)) < len(which):
            raise ValueError(f"index: every world must occur once, got {checks.show(read)}")
        if not len(which):
            return
        given, sizes = _checked_cells(cells, self.backend, "cells")
        if len(sizes) != len(which) or (sizes != self._sizes[which]).any():
            wanted, found = self._sizes[which].tolist(), sizes.tolist()
            raise ValueError(f"cells: sizes must be those of the worlds, {wanted[:3]} ..., got {found[:3]} ...")
        self._put(which, given)
        for stack in self.stacks(which):
            for table in self._tables.values():
                table.fill(stack, table.buffer)
        self.backend.synchronize()
        self._space.wait()

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
            ignore: (N,) index of the shape that each disc ignores, or one for all; -1 for none.
            unknown: Treatment of unknown cells: ``"free"`` or ``"occupied"``.

        Returns:
            (N,) bool; for poses on the device an array of the same library with 0 and 1.

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
        from gpusense.tables.world_index import WorldIndex

        cells = checks.real("radius", radius, low=0) / self._resolution
        checks.choice("unknown", unknown, ("free", "occupied"))
        backend, single, there = self.backend, False, arrays.on_device(poses)
        if there:
            buffer, count, single, _ = arrays.adopt_poses(poses, backend, "poses")
        else:
            host = checks.array("poses", arrays.host_poses(poses, "poses"), ("N", 3))
            buffer, count = backend.upload(host), len(host)
        inside = WorldIndex(self, world, ignore, count, backend).buffers(backend, self._space, (0, count))
        hit = backend.blank(count, _BYTE) if there else backend.empty(count, _BYTE)
        if count:
            self._collide(buffer, count, single, inside, hit, cells, int(unknown == "occupied"))
        if there:
            return arrays.lent(poses, backend, hit, (count,), _BYTE)
        return backend.download(hit, np.empty(count, np.uint8)).view(bool)

    def _collide(
        self, poses: Buffer, count: int, single: bool, inside: InWorlds, hit: Buffer, radius: float, unknown: int
    ) -> None:
        """Place poses, and tell which discs about them, with a radius in cells, meet anything."""
        space, real = self._space, np.dtype(np.float32)
        cell, pose = space.empty("cell", 2 * count, _INT), space.empty("pose", 4 * count, real)
        world, status = space.empty("placed", 4 * count, _INT), self.backend.upload(np.zeros(2, _INT))
        frame = Frame(0.0, 0.0, self._resolution, 0.0, 0.0, 1.0, 0.0)
        flags = inside.flags | flags_if(POSES_FLOAT32=single, HUGE_HEADINGS=True)
        self.backend.run((
            launch(
                "place_in_worlds", flags, (count,), poses=poses, index=inside.index, ignore=inside.ignore,
                frames=self.frames, pose_cell=cell, pose=pose, pose_low=space.empty("low", 4, real), world=world,
                pose_status=status, frame=frame, particles=count, worlds=len(self), wide=inside.wide,
                wide_ignore=inside.wide_ignore,
            ),
            launch(
                "find_collisions", inside.flags, (count,), store=self._store, world=world,
                shapes=self.crowd.table(real), pose_cell=cell, pose=pose, hit=hit, particles=count, radius=radius,
                crowd=inside.crowd, threshold=self._threshold, unknown=unknown,
            ),
        ))  # fmt: skip
        state = self.backend.download(status, np.zeros(2, _INT))
        space.wait()
        if state[0] > 1:
            raise ValueError("world: every index must be one of the worlds, got an index on the device that is not")
        if state[0]:
            raise ValueError("poses: must be finite, got a pose on the device that is not")

    # ---- tables

    def table(self, key: Hashable, make: Callable[[], Table]) -> Table:
        """Return a table of all worlds; models share it.

        Args:
            key: Everything on which the table depends, except the cells.
            make: Function that returns the table before it is filled.

        Raises:
            MemoryError: The device does not hold it.
        """
        if key not in self._tables:
            table = make()
            for stack in self.stacks(np.arange(len(self))):
                table.fill(stack, table.buffer)
                self.backend.synchronize()
            self._space.release()
            self._tables[key] = table
        return self._tables[key]

    @property
    def largest_table(self) -> int:
        """Largest size of a table of all worlds [bytes]."""
        numbers = 8 * _MOST_CELLS if self.device.backend == "warp" else self.device.max_buffer
        return min(self.device.max_buffer, numbers)

    def allocate(self, each: int, dtype: np.dtype) -> Buffer:
        """Return a buffer for ``each`` numbers of each cell of all worlds.

        Raises:
            MemoryError: The device does not hold it; the message says how many worlds fit.
        """
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
        sizes, groups = np.unique(self._sizes[indices], axis=0, return_inverse=True)
        for number, (rows, cols) in enumerate(sizes.tolist()):
            members = indices[groups.reshape(-1) == number]
            each = max(_TOGETHER[self.backend.info.kind] // (rows * cols), 1)
            for first in range(0, len(members), each):
                part = members[first : first + each]
                place = self.backend.upload(self._place[part])
                yield Stack(part, rows, cols, place, self._space)

    def marked(self, stack: Stack, unknown: str, margin: int = 0) -> tuple[Buffer, Buffer]:
        """Return the obstacles of a stack as bytes and as bits, with a margin of obstacles around each world."""
        rows, cols = stack.rows + 2 * margin, stack.cols + 2 * margin
        lines, words = rows * stack.worlds, -(-cols // 32)
        occupied = stack.space.empty("occupied", lines * cols, _BYTE)
        bits = stack.space.empty("bits", lines * words, _INT)
        self._run(
            "mark_obstacles", (words, lines), store=self._store, place=stack.place, occupied=occupied, bits=bits,
            rows=stack.rows, cols=stack.cols, worlds=stack.worlds, words=words, margin=margin,
            threshold=self._threshold, unknown=int(unknown == "occupied"),
        )  # fmt: skip
        return occupied, bits

    def put(self, index: int, table: Buffer, numbers: np.ndarray, each: int) -> None:
        """Copy numbers from host memory to a world's part of a table with ``each`` numbers of a cell."""
        first = int(self._place[index]) * each
        self.backend.upload(numbers.reshape(-1), self.backend.part(table, first, numbers.size, numbers.dtype))

    def watch(self, one: WorldMap) -> None:
        """Tell a model's map when the shapes get other numbers."""
        self._maps.add(one)

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
        step = len(indices) if buffer is not None else max((1 << 28) // count, 1)
        for first in range(0, len(indices), step):
            part = indices[first : first + step]
            cells = buffer
            if buffer is None:
                cells = self.backend.upload(np.ascontiguousarray(given[first : first + step]).view(_BYTE))
            place = self.backend.upload(self._place[part])
            self._run(
                "put_cells", (count, len(part)), cells=cells, place=place, store=self._store, count=count,
                worlds=len(part),
            )  # fmt: skip
            self.backend.synchronize()

    def _run(self, kernel: str, size: tuple[int, ...], **arguments: Any) -> None:
        self.backend.run((launch(kernel, _NO_FLAGS, size, **arguments),))

    def _frames(self) -> np.ndarray:
        """Return the frames of all worlds; see the kernel file ``worlds``."""
        frames = np.zeros((len(self), 8))
        known: dict[Any, Any] = {}
        for number, origin in enumerate(self._origins):
            if origin not in known:
                known[origin] = frame_of(_Corner(origin, self._resolution, (1, 1)), (0.0, 0.0, 0.0))
            frame = known[origin]
            frames[number, :4] = frame.origin_x, frame.origin_y, frame.yaw_cos, frame.yaw_sin
        frames[:, 4:6], frames[:, 6] = self._sizes, self._place
        return frames


class _Corner(NamedTuple):
    """The corner of a world, as ``frame_of`` takes it."""

    origin: tuple[float, float, float]
    resolution: float
    shape: tuple[int, int]


class WorldMap:
    """The table of all worlds for a model, in place of a map's reachable window.

    Args:
        worlds: The worlds.
        make: Function that returns the table.

    Attributes:
        grid: The worlds.
        window: A window of the size of the largest world.
        table: The table; None before it is made.
    """

    def __init__(self, worlds: Worlds, make: Callable[[], Buffer]) -> None:
        self.grid, self._make, self.version, self.preparations = worlds, make, 0, 0
        self.table: Buffer = None
        self.window = Window(0, 0, *worlds.shape)
        worlds.watch(self)

    def ensure(self, corners: object) -> WorldMap:
        """Return the map with its table."""
        if self.table is None:
            self.table = self._make()
            self.preparations, self.version = 1, self.version + 1
        return self

    def drop(self) -> None:
        """Keep the table: it belongs to the worlds."""

    def omission(self, bytes_per_cell: float) -> None:
        """Return None: worlds are prepared as a whole."""

    def update(self, cells: object, place: object) -> OccupancyGrid:
        """Refuse a change of cells."""
        raise ValueError("grid: must be a single map for update_map, got Worlds; worlds.replace(index, cells) does it")


def _of_grids(
    grids: Sequence[Any], resolution: float | None, origin: Any, threshold: int | None
) -> tuple[float, Any, int]:
    """Return the resolution, the origins and the threshold of a list of grids."""
    for number, grid in enumerate(grids):
        checks.instance(f"cells[{number}]", grid, OccupancyGrid)
    sides = sorted({grid.resolution for grid in grids} | ({resolution} if resolution is not None else set()))
    if len(sides) > 1:
        raise ValueError(f"resolution: must be the same for all worlds, got {sides}")
    thresholds = sorted({grid.occupied_threshold for grid in grids} | ({threshold} if threshold is not None else set()))
    if len(thresholds) > 1:
        raise ValueError(f"occupied_threshold: must be the same for all worlds, got {thresholds}")
    return sides[0], [grid.origin for grid in grids] if origin is None else origin, thresholds[0]


def _checked_cells(cells: Any, backend: Backend, name: str) -> tuple[Any, np.ndarray]:
    """Return cells after checking them, and the (M, 2) sizes of the worlds.

    Returns:
        (M, H, W) int8 in host memory, an array on the device, or a list of (H, W) int8 of several sizes.
    """
    if arrays.on_device(cells):
        adopted = arrays.adopt_integers(cells, backend, name, ("int8",))
        shape = adopted.shape
        if len(shape) != 3 or math.prod(shape) == 0:
            raise ValueError(f"{name}: shape must be (M, H, W) with a cell at least, got {checks.shape_text(shape)}")
        _check_side(name, shape[1:])
        return adopted, np.tile(shape[1:], (shape[0], 1))
    if isinstance(cells, (list, tuple)) and len(cells):
        each = [OccupancyGrid(arrays.to_host(one, f"{name}[{number}]"), 1.0).cells for number, one in enumerate(cells)]  # type: ignore[arg-type]
        for one in each:
            _check_side(name, one.shape)
        sizes = np.array([one.shape for one in each])
        return (np.stack(each) if (sizes == sizes[0]).all() else each), sizes
    values = checks.as_array(name, arrays.to_host(cells, name))
    if values.ndim != 3 or values.size == 0:
        raise ValueError(f"{name}: shape must be (M, H, W) with a cell at least, got {checks.shape_text(values.shape)}")
    _check_side(name, values.shape[1:])
    flat = OccupancyGrid(values.reshape(-1, values.shape[2]), 1.0).cells
    return flat.reshape(values.shape), np.tile(values.shape[1:], (len(values), 1))


def _check_side(name: str, shape: tuple[int, ...]) -> None:
    """Refuse worlds with sides that distances in 32 bits do not allow."""
    if max(shape) > LONGEST_SIDE:
        size = f"{shape[0]} x {shape[1]}"
        raise ValueError(f"{name}: a world must have at most {LONGEST_SIDE} rows and columns, got {size}")


def _checked_origins(origin: Any, count: int) -> list[tuple[float, float, float]]:
    """Return the pose of each world's corner."""
    from gpusense.world.grid_frame import check_origin

    if origin is None:
        return [(0.0, 0.0, 0.0)] * count
    values = checks.as_array("origin", origin)
    if values.ndim == 2:
        poses = checks.array("origin", values, (count, 3))
        return [check_origin(pose) for pose in poses]
    return [check_origin(values)] * count
