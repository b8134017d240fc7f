"""Ray casting on its own: expected ranges of poses and bearings."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gpusense._util import checks
from gpusense.backends import Backend, BackendInfo, Selection, arrays, get_backend
from gpusense.backends.base import Buffer
from gpusense.backends.workspace import Workspace
from gpusense.interface.lanes import widened
from gpusense.interface.plan import Omission
from gpusense.models.arguments import check_scene, real_dtype
from gpusense.models.chunks import chunk_of, in_chunks
from gpusense.models.cloud import Cloud, all_within, finish, ordered, tiles_of
from gpusense.models.scan.cones import LASER, Cones, require_exact
from gpusense.tables import casters
from gpusense.tables.casters import Caster, Window
from gpusense.tables.lookup_files import describe, write_lookup
from gpusense.tables.normals import normal_table
from gpusense.tables.reachable import ReachableMap, TableMemoryError
from gpusense.world.frames import Mount, ray_vectors
from gpusense.world.grid import OccupancyGrid
from gpusense.world.windows import Region

_NO_MOUNT: Mount = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class CasterMethod:
    """A way to find expected ranges.

    Attributes:
        name: What to pass as ``method=`` or ``caster=``.
        error: ``"exact"``, or the bound of its error.
        memory: Bytes on the device.
        precomputation: What is made of the map beforehand.
        backends: Where it runs.
        knobs: What its error and its time depend on; arguments of the class in ``gpusense.casters``.
    """

    name: str
    error: str
    memory: str
    precomputation: str
    backends: tuple[str, ...]
    knobs: str


class RayCaster:
    """Distance to the first occupied cell along rays.

    Args:
        grid: The map.
        range_max: Longest range [m], > 0; what a ray without a nearer obstacle returns.
        method: A name of ``RayCaster.methods()``, or one of ``gpusense.casters`` with knobs of its own, such as
            ``casters.March(tolerance=0.02)``.
        backend: Where it runs, see ``gpusense.devices()``; or a queue of pyopencl.
        precision: ``"float32"`` or ``"float64"``.
        unknown: Whether unknown cells are ``"free"`` or ``"occupied"``.
        outside: Whether what lies outside the grid is ``"free"`` or ``"occupied"``.

    Raises:
        TypeError: an argument is of the wrong kind.
        ValueError: an argument breaks its rule, or the device is absent.
    """

    def __init__(
        self,
        grid: OccupancyGrid,
        range_max: float,
        *,
        method: str | Caster = "exact",
        backend: Selection = "auto",
        precision: str = "float32",
        unknown: str = "free",
        outside: str = "free",
    ) -> None:
        self.range_max = checks.real("range_max", range_max, above=0)
        self.grid = check_scene(grid, self.range_max)
        self.method = casters.choose("method", method)
        self.unknown = checks.choice("unknown", unknown, ("free", "occupied"))
        self.outside = checks.choice("outside", outside, ("free", "occupied"))
        device = get_backend(backend)
        real = real_dtype(precision, device)
        self._caster = MapCaster(
            device, real, grid, _NO_MOUNT, self.range_max, self.method, unknown=unknown, outside=outside, crop=True
        )

    @staticmethod
    def methods() -> tuple[CasterMethod, ...]:
        """The methods there are, with their error, memory, precomputation, backends and knobs."""
        everywhere = ("numpy", "opencl", "warp")
        return tuple(
            CasterMethod(kind.name, kind.error, kind.memory, kind.precomputation, everywhere, kind.knobs)
            for kind in casters.CASTERS.values()
        )

    @property
    def device(self) -> BackendInfo:
        """The device the caster is compiled for."""
        return self._caster.backend.info

    @property
    def precision(self) -> str:
        """``"float32"`` or ``"float64"``."""
        return self._caster.real.name

    @property
    def table_bytes(self) -> int:
        """Bytes of the map's table on the device; 0 before the first cast."""
        return self._caster.table_bytes

    def prepare(self, poses: object) -> None:
        """Make the map's table for a cloud of (N, 3) poses now; ``cast`` does it otherwise.

        Raises:
            TypeError, ValueError: poses that are not (N, 3) finite numbers.
            MemoryError: the device cannot hold the table.
        """
        self._caster.prepare(Cloud(poses, self._caster.backend))

    def update_map(self, cells: object, region: object) -> None:
        """Replace cells of the map; afterwards every range is that of a caster of the changed grid.

        The exact caster mends its table where rectangles can hold a changed obstacle, up to 254 cells off; the others
        make theirs anew with the next cast.

        Args:
            cells: (h, w) integers as ``OccupancyGrid.cells``: occupancy in per cent, or -1 for unknown.
            region: (row, col) of the cell that ``cells[0, 0]`` replaces.

        Raises:
            TypeError, ValueError: cells or a region that are not integers, or do not fit the grid, or a look-up table
                from a file; nothing has changed.
        """
        self.grid = self._caster.update(cells, region)

    def save_table(self, path: str | Path) -> None:
        """Write the look-up table, whole or not at all, for ``casters.Lookup(bins, file=path)``.

        Raises:
            ValueError: the method has no table that is worth keeping: only ``"lookup"`` has.
            OSError: the file cannot be written.
        """
        if not isinstance(self.method, casters.Lookup):
            raise ValueError(f"method: must be 'lookup' for a table to be saved, got {self.method.name!r}")
        self._caster.save(checks.path("path", path), self.method.bins)

    def cast(self, poses: object, bearings: object, *, out: Any = None) -> Any:
        """Expected ranges.

        Args:
            poses: (N, 3) ray origins and headings in the world [m, m, rad]. Arrays of other libraries are used where
                they are, and ranges come back in the same library; see ``BeamModel.log_likelihood``.
            bearings: (K,) directions relative to the heading [rad].
            out: Where to write the ranges: (N, K) in the caster's precision, C-contiguous, where the poses are.

        Returns:
            (N, K) metres in the caster's precision: 0 inside an occupied cell, exactly ``range_max`` where nothing is
            nearer.

        Raises:
            TypeError, ValueError: arguments that are not finite numbers of these shapes.
        """
        vectors = ray_vectors(checks.array("bearings", bearings, ("K",)), _NO_MOUNT)
        return self._caster.cast(poses, vectors, out)

    def incidence(self, poses: object, bearings: object, *, out: Any = None) -> Any:
        """Angles of incidence: between each ray and the normal of the surface that it hits.

        Normals are those of ``surface_normals``, of the cell in which the exact ray ends; a cell without one counts as
        met head-on.

        Args:
            poses: As for ``cast``.
            bearings: As for ``cast``.
            out: Where to write the angles, as for ``cast``.

        Returns:
            (N, K) radians in [0, pi / 2], 0 head-on; NaN where nothing is nearer than ``range_max``.

        Raises:
            TypeError, ValueError: arguments that are not finite numbers of these shapes, or a method that is not exact.
        """
        vectors = ray_vectors(checks.array("bearings", bearings, ("K",)), _NO_MOUNT)
        require_exact("method", self.method)
        return self._caster.cast(poses, vectors, out, Cones(incidence=True))


class MapCaster:
    """The caster of one map, sensor mount and range on one device; models share its table of the map.

    Args:
        backend: The device.
        real: Precision.
        grid: The map.
        mount: The sensor's pose on the robot; its yaw belongs to the ray vectors.
        range_max: Longest range [m].
        method: How ranges are found.
        unknown: Whether unknown cells are ``"free"`` or ``"occupied"``.
        outside: Whether what lies outside the grid is ``"free"`` or ``"occupied"``.
        crop: False prepares the whole map at once.
    """

    def __init__(
        self,
        backend: Backend,
        real: np.dtype,
        grid: OccupancyGrid,
        mount: Mount,
        range_max: float,
        method: Caster,
        *,
        unknown: str,
        outside: str,
        crop: bool,
    ) -> None:
        self.backend, self.real, self.grid, self.mount, self.range_max = backend, real, grid, mount, range_max
        self.limit = range_max / grid.resolution
        self.method, self.outside, self._table_bytes = method, outside, 0
        # Normals of the map's walls, and the window they belong to.
        self._normals: tuple[Region, Buffer, int] | None = None
        self._no_normals = backend.upload(np.zeros(2, real))
        self.map = ReachableMap(
            backend, grid, unknown, mount, self.limit, self._prepare, crop and not method.whole, self._mend
        )
        self._own_flags = frozenset({"OUTSIDE_OCCUPIED"} if outside == "occupied" else ())
        self._own_flags |= {method.flag} if method.flag else set()
        # Those of the table once there is one.
        self.flags = self._own_flags
        self._wide = {"FLOAT64"} if real == np.float64 else set()
        self._workspace = Workspace(backend)
        # Threads may share a caster: its buffers serve one call at a time.
        self._lock = threading.Lock()

    @property
    def table_bytes(self) -> int:
        """Bytes of the map's tables on the device."""
        return self._table_bytes + (0 if self._normals is None else self._normals[2])

    def normals(self, region: Region, flags: frozenset[str]) -> Buffer:
        """Normals of the walls in a window, where flags ask for them; made once for a window.

        Raises:
            TableMemoryError: the device cannot hold them.
        """
        if "INCIDENCE" not in flags:
            return self._no_normals
        if self._normals is None or self._normals[0] != region:
            self._normals = None
            try:
                table = normal_table(self.map.obstacles, region, self.outside, self.real)
                self._normals = (region, self.backend.upload(table), table.nbytes)
            except MemoryError as error:
                raise TableMemoryError(*error.args) from error
        return self._normals[1]

    @property
    def scalars(self) -> tuple[Any, ...]:
        """The kernels' arguments bins, slack and tolerance."""
        return self.method.scalars()

    def omission(self) -> Omission | None:
        """What cropping the map left out, once a cloud has been seen."""
        region = self.map.region
        return self.map.omission(self.table_bytes / region.cells) if region is not None else None

    def _prepare(self, backend: Backend, obstacles: np.ndarray) -> Buffer:
        table = self.method.prepare(backend, Window(obstacles, self.limit, self.outside))
        self._table_bytes = table.size
        self.flags = self._own_flags | table.flags
        return table.buffer

    def _mend(self, backend: Backend, obstacles: np.ndarray, table: Buffer, changed: Region) -> bool:
        return self.method.mend(backend, Window(obstacles, self.limit, self.outside), table, changed)

    def update(self, cells: object, region: object) -> OccupancyGrid:
        """Replace cells of the map, and return it."""
        if isinstance(self.method, casters.Lookup) and self.method.file is not None:
            raise ValueError(f"file: must be None where the map changes, got {checks.show(self.method.file)}")
        with self._lock:
            self.grid, self._normals = self.map.update(cells, region), None
            return self.grid

    def prepare(self, cloud: Cloud) -> None:
        """Make the table for a cloud."""
        if cloud.count:
            with self._lock:
                cloud.ensure(self.map, 0, cloud.count)

    def save(self, path: Path, bins: int) -> None:
        """Write the look-up table."""
        with self._lock:
            buffer, region = self.map.ensure([self.grid.origin])
            entries = self.backend.download(buffer, np.empty(region.cells * bins, np.uint16))
            obstacles = region.cut(self.map.obstacles)
        write_lookup(path, entries, describe(obstacles, self.limit, self.outside, bins))

    def cast(self, poses: object, vectors: np.ndarray, out: object = None, cones: Cones = LASER) -> Any:
        """Expected ranges, or angles of incidence, (N, K) of (N, 3) poses and (K, 2) ray vectors, in pieces that fit.

        Vectors of cones are (K, C, 2).
        """
        cloud, rays = Cloud(poses, self.backend), len(vectors)
        given = arrays.check_out(out, (cloud.count, rays), self.real, poses, self.backend)
        ranges: Any
        if cloud.on_device:
            ranges = arrays.blank(self.backend, cloud.count * rays, self.real) if given is None else given
        else:
            ranges = np.empty((cloud.count, rays), self.real) if given is None else given
        if cloud.count * rays:
            with self._lock, self._workspace:
                ray = self._workspace.upload("ray", vectors.astype(self.real))
                chunk = chunk_of(self.backend, rays * cones.rays, self.real.itemsize)
                in_chunks(
                    cloud.count, chunk, self._workspace,
                    lambda begin, end: self._cast_chunk(cloud, (begin, end), ray, rays, ranges, cones),
                )  # fmt: skip
                finish(self._workspace, cloud.on_device)
        if out is not None:
            return out
        if cloud.on_device:
            return arrays.lent(poses, self.backend, ranges, (cloud.count, rays), self.real)
        return arrays.like(poses, ranges)

    def _cast_chunk(
        self, cloud: Cloud, part: tuple[int, int], ray: Buffer, rays: int, ranges: Any, cones: Cones
    ) -> None:
        space, backend, count = self._workspace, self.backend, part[1] - part[0]
        table, region, corners = cloud.ensure(self.map, *part)
        normals = self.normals(region, cones.flags)
        given = cloud.given(backend, space, part)
        placed = cloud.place(backend, space, given, part, (region, self.grid, self.mount), self.real, careful=False)
        flags = self.flags | self._wide | cones.flags
        flags |= set() if all_within(corners, self.grid, self.mount, region, 0) else {"ORIGINS_OUTSIDE"}
        sizes = (region.rows, region.cols, count, rays, *self.scalars, self.limit, self.grid.resolution, self.range_max)
        flat = ranges if cloud.on_device else ranges.reshape(-1)
        with space.result("ranges", flat, part[0] * rays, count * rays, self.real) as result:
            if "ECHO" in flags:
                other = space.empty("echoes", count * rays if "INCIDENCE" in flags else 1, self.real)
                both = (other, result) if cones.incidence else (result, other)
                inputs = (table, normals, placed.cell, placed.pose, ray)
                backend.compile("cast_echoes", flags)(
                    (rays, count), *inputs, *both, *sizes[:4], *cones.scalars, *sizes[4:]
                )
            elif backend.info.kind == "gpu":
                order = ordered(backend, space, placed, count, rays, self.real)
                flags |= {"ORDERED"} if order is not None else set()
                order = placed.cell if order is None else order
                tiles, spread = tiles_of(count, rays)
                backend.compile("cast_tiles", flags)(
                    (tiles,), table, placed.cell, placed.pose, order, ray, result, *sizes, spread
                )
            else:
                flags = widened(backend.info.lanes, "cast_ranges", flags)
                backend.compile("cast_ranges", flags)(
                    (rays, count), table, placed.cell, placed.pose, ray, result, *sizes
                )
