"""The caster of one map, sensor mount and range on one device; models share its table of the map."""

from __future__ import annotations

import functools
import math
import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np

from gpusense._util import checks
from gpusense.backends import Backend
from gpusense.backends.arrays import Result
from gpusense.backends.base import Buffer
from gpusense.backends.workspace import PartialResult, Workspace
from gpusense.interface import structs
from gpusense.interface.flags import flags_if
from gpusense.interface.lanes import with_lanes_flag, with_teams_flags
from gpusense.interface.launches import Program, launch
from gpusense.interface.plan import Omission
from gpusense.interface.structs import RangeScale
from gpusense.models.chunking import Piece, chunk_of, finish, run_pieces
from gpusense.models.poses import Part, PlacedPoses, Poses, place
from gpusense.models.scan import tiles
from gpusense.models.scan.sampling import Drawing
from gpusense.tables import casters
from gpusense.tables.casters import Caster, CasterInput
from gpusense.tables.crowd import turns_of
from gpusense.tables.lookup_files import describe, write_lookup
from gpusense.tables.reachable import MapState, ObstaclesOf, ReachableMap, TableMemoryError, obstacles_of
from gpusense.tables.rectangles import rectangles_of_worlds
from gpusense.tables.world_map import WorldMap, check_worlds, index_of
from gpusense.tables.worlds import Worlds
from gpusense.world.frames import Mount
from gpusense.world.grid import OccupancyGrid
from gpusense.world.scanner import Scanner
from gpusense.world.windows import Window


@dataclass(frozen=True)
class Cones:
    """Cones of a sensor."""

    rays: int = 1  # rays of each cone; 1 for a laser
    critical: float = 0.0  # least cosine of an angle of incidence at which a surface returns; 0 without a limit
    incidence: bool = False  # true if angles of incidence are computed, not ranges

    @property
    def struct(self) -> structs.Cone:
        """The cone as kernels take it."""
        return structs.Cone(self.rays, self.critical)

    @functools.cached_property
    def flags(self) -> frozenset[str]:
        """The kernels' flags."""
        incidence = self.incidence or self.critical > 0
        return flags_if(CONES=incidence or self.rays > 1, INCIDENCE=incidence)

    def words(self, critical: float | None) -> str:
        """Return the words of a plan's title; ``critical`` is the largest angle that returns [rad]."""
        cone = f", cones of {self.rays} rays" if self.rays > 1 else ""
        return cone + (f", no return beyond {critical:g} rad of incidence" if critical is not None else "")


def cones_of(scanner: Scanner, method: Caster, *, incidence: bool) -> Cones:
    """Return the cones of a scanner; ``incidence`` says whether its model depends on angles of incidence."""
    critical = scanner.critical_incidence
    least = 0.0 if critical is None or critical >= math.pi / 2 else max(math.cos(critical), 0.0)
    if critical is not None and not method.exact:
        value = f"critical_incidence = {checks.show(critical)}"
        raise ValueError(f"caster: must be an exact one for a scanner with {value}, got {method.name!r}")
    if incidence:
        require_exact("caster", method)
    return Cones(scanner.cone_rays, least, incidence)


def require_exact(argument: str, method: Caster) -> None:
    """Refuse casters that do not find the cell in which a ray ends."""
    if not method.exact:
        raise ValueError(f"{argument}: must be an exact one where angles of incidence matter, got {method.name!r}")


LASER = Cones()
# Most rays of a team of work-items, as in the kernel file ``ranges``, number of teams that fill any GPU, and
# most teams of a launch.
_RAYS_OF_TEAM, _ENOUGH_TEAMS, _MOST_TEAMS = 384, 4096, (1 << 25) - 1


class Rays(NamedTuple):
    """Rays on a device."""

    vectors: Buffer  # their vectors
    turns: Buffer | None = None  # their order by direction, see ``turns_of``; None in a single map
    ordered: Buffer | None = None  # their vectors in this order


class MapCaster:
    """The caster of one map, sensor mount and range on one device; models share its table of the map.

    ``mount``: the sensor's pose on the robot; its yaw belongs to the ray vectors; ``crop``: False prepares the whole
    map at once; ``obstacles_of``: function from a grid and ``unknown`` to the mask of the cells that stop a beam.
    """

    def __init__(
        self,
        backend: Backend,
        real: np.dtype,
        grid: OccupancyGrid | Worlds,
        mount: Mount,
        range_max: float,
        method: Caster,
        *,
        unknown: str,
        outside: str,
        crop: bool,
        obstacles_of: ObstaclesOf = obstacles_of,
    ) -> None:
        self.backend, self.real, self.mount, self.range_max = backend, real, mount, range_max
        self.limit = range_max / grid.resolution
        self.method, self.outside, self._table_bytes = method, outside, 0
        # Window of the normals of the map's walls, the normals, and their size [bytes].
        self._normals: tuple[Window, Buffer, int] | None = None
        self._unknown = unknown
        self._worlds = grid if isinstance(grid, Worlds) else None
        self.map: ReachableMap
        if isinstance(grid, Worlds):
            if not isinstance(method, casters.Exact):
                raise ValueError(f"caster: must be 'exact' in Worlds, got {method.name!r}")
            # The same interface, with the table of all worlds.
            self.map = cast(ReachableMap, WorldMap(check_worlds(grid, backend), mount, self._prepare_worlds))
        else:
            self.map = ReachableMap(
                backend, grid, unknown, mount, self.limit + method.beyond, self._prepare, crop and not method.whole,
                self._refresh, obstacles_of=obstacles_of,
            )  # fmt: skip
        # The exact caster has no flag.
        caster = {method.entry.flag: method.entry.flag != ""}
        self._fixed_flags = flags_if(OUTSIDE_OCCUPIED=outside == "occupied", **caster)
        # Include the table's flags once it is made.
        self.flags = self._fixed_flags
        self._precision_flags = flags_if(FLOAT64=real == np.float64)
        self._workspace = Workspace(backend)
        # Threads may share a caster: its buffers serve one call at a time.
        self.lock = threading.Lock()

    @property
    def grid(self) -> OccupancyGrid | Worlds:
        """The current map."""
        return self.map.grid if self._worlds is None else self._worlds

    @property
    def table_bytes(self) -> int:
        """Bytes of the map's tables on the device."""
        return self._table_bytes + (0 if self._normals is None else self._normals[2])

    def normals(self, window: Window) -> Buffer:
        """Return the normals of the walls in a window, made once for a window."""
        if self._worlds is not None:
            from gpusense.tables.normals import normals_of_worlds

            return normals_of_worlds(self._worlds, self._unknown, self.outside, self.real).buffer
        if self._normals is None or self._normals[0] != window:
            from gpusense.tables.normals import normal_table

            self._normals = None
            try:
                table = normal_table(self.map.obstacles, window, self.outside, self.real)
                self._normals = (window, self.backend.upload(table), table.nbytes)
            except MemoryError as error:
                raise TableMemoryError(*error.args) from error
        return self._normals[1]

    @property
    def scale(self) -> RangeScale:
        """The scale of ranges."""
        return RangeScale(self.limit, self.grid.resolution, self.range_max)

    def omission(self) -> Omission | None:
        """Return the omission by cropping the map, None before the first cloud."""
        window = self.map.window
        return self.map.omission(self.table_bytes / window.cells) if window is not None else None

    def _prepare(self, backend: Backend, obstacles: np.ndarray) -> Buffer:
        table = self.method.prepare(backend, CasterInput(obstacles, self.limit, self.outside))
        self._table_bytes = table.size
        self.flags = self._fixed_flags | table.flags
        return table.buffer

    def _prepare_worlds(self) -> Buffer:
        """Return the empty rectangles of all worlds."""
        assert self._worlds is not None
        table, flags = rectangles_of_worlds(self._worlds, self._unknown)
        self._table_bytes = table.size
        self.flags = self._fixed_flags | flags
        return table.buffer

    def _refresh(self, backend: Backend, obstacles: np.ndarray, table: Buffer, changed: Window) -> bool:
        return self.method.refresh(backend, CasterInput(obstacles, self.limit, self.outside), table, changed)

    def update(self, cells: object, region: object) -> OccupancyGrid:
        """Replace cells of the map, and return it."""
        if isinstance(self.method, casters.Lookup) and self.method.file is not None:
            raise ValueError(f"file: must be None where the map changes, got {checks.show(self.method.file)}")
        with self.lock:
            # Drop the normals first: an interrupt may come before the map has changed, but not between the map and its
            # normals.
            self._normals = None
            return self.map.update(cells, region)

    def prepare(self, poses: Poses) -> None:
        """Make the table for some poses."""
        if poses.count:
            with self.lock:
                poses.ensure_table(self.map, (0, poses.count), self.backend)

    def save(self, path: Path, bins: int) -> None:
        """Write the look-up table."""
        with self.lock:
            state = self.map.ensure([self.grid.origin])
            entries = self.backend.download(state.table, np.empty(state.window.cells * bins, np.uint16))
            obstacles = state.window.cut(self.map.obstacles)
        write_lookup(path, entries, describe(obstacles, self.limit, self.outside, bins))

    def cast(
        self, poses: object, vectors: np.ndarray, out: object = None, cones: Cones = LASER, *, world: Any = None,
        ignore: Any = None,
    ) -> Any:  # fmt: skip
        """Cast (K, 2) ray vectors, or (K, C, 2) of cones, in pieces that fit the memory; see ``RayCaster.cast``.

        Returns:
            (N, K) expected ranges, or angles of incidence.
        """
        rays = len(vectors)
        checked = Poses(poses, self.backend, late=rays > 0)
        if self._worlds is not None or world is not None or ignore is not None:
            checked.inside = index_of(self.grid, world, ignore, checked.count, self.backend)
        result = Result(poses, out, (checked.count, rays), self.real, self.backend, on_device=checked.on_device)
        if checked.count * rays:
            with self.lock, self._workspace:
                ray = self.rays(vectors, self._workspace)
                chunk = chunk_of(self.backend, rays * cones.rays + checked.sights, self.real.itemsize)
                run_pieces(
                    self._workspace, Piece(0, checked.count, checked.count), chunk,
                    lambda piece: self._cast(checked, piece, ray, rays, result.flat, cones),
                )  # fmt: skip
                finish(self._workspace, checked.on_device)
        return result.user_array()

    def rays(self, vectors: np.ndarray, space: Workspace) -> Rays:
        """Return ray vectors on the device, copied where the last call had others."""
        key = vectors.shape, vectors.tobytes()
        ray = space.hold("ray", key, lambda: vectors.astype(self.real))
        if self._worlds is None:
            return Rays(ray)
        flat = functools.cache(lambda: vectors.astype(self.real).reshape(-1, 2))
        turns = space.hold("turns", key, lambda: turns_of(flat()))
        return Rays(ray, turns, space.hold("ordered", key, lambda: flat()[turns_of(flat())[-len(flat()) :]]))

    def draw(self, poses: Poses, vectors: np.ndarray, flat: Any, cones: Cones, drawing: Drawing) -> None:
        """Draw readings at S N poses into flat memory, in pieces that fit the device's memory.

        A device without float64 casts the ranges, and the host draws: the bits are the same.
        """
        rays = len(vectors)
        if not poses.count * rays:
            return
        with self.lock, self._workspace as space:
            ray = self.rays(vectors, space)
            chunk = chunk_of(self.backend, rays * cones.rays + poses.sights, 2 * self.real.itemsize)
            # Random numbers depend on the index of a particle among all, so scans may be split.
            run_pieces(
                space, Piece(0, poses.count, poses.count), chunk,
                lambda piece: self._draw(poses, piece, ray, rays, flat, cones, drawing),
            )  # fmt: skip
            finish(space, poses.on_device)

    def _draw(
        self, poses: Poses, piece: Piece, ray: Rays, rays: int, flat: Any, cones: Cones, drawing: Drawing
    ) -> None:
        """Start drawing the readings of a piece."""
        space, count, info = self._workspace, piece.count, self.backend.info
        placed, state = self._place(poses, piece.part, space, cones)
        cosines = space.empty("cosines", count * rays if "INCIDENCE" in cones.flags else 1, self.real)
        result = PartialResult(space, "ranges", flat, piece.begin * rays, count * rays, self.real)
        self._run(placed, state, ray, rays, cones, self._flags(placed, cones) | {"COSINES"}, result.buffer, cosines)
        if info.float64:
            self.backend.run((drawing.launch(space, piece.begin, count, rays, result.buffer, cosines),))
        result.deliver()
        if not info.float64:
            incidence = np.zeros(count * rays if drawing.bins > 1 else 1, self.real)
            space.download(cosines, incidence)
            space.wait()
            drawing.on_host(piece.begin, count, rays, flat[piece.begin * rays : piece.end * rays], incidence)

    def _cast(self, poses: Poses, piece: Piece, ray: Rays, rays: int, flat: Any, cones: Cones) -> None:
        space, count = self._workspace, piece.count
        placed, state = self._place(poses, piece.part, space, cones)
        result = PartialResult(space, "ranges", flat, piece.begin * rays, count * rays, self.real)
        other = space.empty("echoes", count * rays, self.real) if "INCIDENCE" in cones.flags else None
        both = (other, result.buffer) if cones.incidence else (result.buffer, other)
        self._run(placed, state, ray, rays, cones, self._flags(placed, cones), *both)
        result.deliver()

    def _place(self, poses: Poses, part: Part, space: Workspace, cones: Cones = LASER) -> tuple[PlacedPoses, MapState]:
        """Place some poses in a window of the map; also return the map with its table."""
        corners = poses.corners(part, self.backend, space)
        state = self.map.ensure(corners)
        sees = "CONES" in cones.flags
        return place(poses, part, state.frame, self.backend, space, self.real, corners, sees=sees), state

    def program(self, poses: Poses, part: Part, ray: Rays, rays: int, ranges: Buffer, space: Workspace) -> Program:
        """Return the launches of a bound call that cast the rays of some poses to ranges."""
        placed, state = self._place(poses, part, space)
        flags, results = self._flags(placed, LASER), dict(ranges=ranges)
        return *placed.launches(), *self._program(placed, state.table, ray, rays, LASER, flags, results, None)

    def _flags(self, placed: PlacedPoses, cones: Cones) -> frozenset[str]:
        """Return the flags that cast the rays of placed poses; the poses must have been placed."""
        outside = flags_if(ORIGINS_OUTSIDE=not placed.within(0))
        return self.flags | self._precision_flags | cones.flags | placed.world_flags | outside

    def _run(
        self, placed: PlacedPoses, state: MapState, ray: Rays, rays: int, cones: Cones, flags: frozenset[str],
        ranges: Buffer, incidence: Buffer,
    ) -> None:  # fmt: skip
        """Cast the rays of placed poses to ranges and, with INCIDENCE, angles of incidence; repeat kept programs."""
        normals = self.normals(state.window) if "INCIDENCE" in cones.flags else None
        changing = dict(poses=placed.source, ranges=ranges, incidence=incidence, normals=normals)
        if placed.inside is not None:
            changing |= placed.changing()
        gpu = self.backend.info.kind == "gpu" and "CONES" not in flags
        # Each run uploads the order's initial bounds.
        order = tiles.order_of(self._workspace, placed, rays, self.real) if gpu else None
        self._workspace.run(
            (flags, placed.key, rays, cones), changing,
            lambda: (*placed.launches(), *self._program(placed, state.table, ray, rays, cones, flags, changing, order)),
            version=state.version,
        )  # fmt: skip

    def _program(
        self, placed: PlacedPoses, table: Buffer, ray: Rays, rays: int, cones: Cones, flags: frozenset[str],
        results: dict[str, Buffer], order: tiles.Order | None,
    ) -> Program:  # fmt: skip
        """Return the launches that cast the rays of placed poses."""
        count, ranges = placed.count, results["ranges"]
        common = dict(
            map_table=table, pose_cell=placed.cell, pose=placed.pose, ray=ray.vectors, window=placed.frame.window,
            particles=count, rays=rays, caster=self.method.struct(), scale=self.scale, ranges=ranges,
            **placed.places(),
        )  # fmt: skip
        if "CONES" in flags:
            heard = dict(normals=results["normals"], incidence=results["incidence"], cone=cones.struct)
            return (launch("cast_echoes", flags, (rays, count), **common, **heard),)
        flags -= {"COSINES"}
        shapes: Program = ()
        if "SHAPES" in flags:
            shapes, ended = self._meet_shapes(placed, ray, rays, flags, common)
            if ended:
                return shapes
        if self.backend.info.kind == "gpu" and not (self._worlds is not None and rays >= tiles.LEAST_OF_ONE_POSE):
            flags |= flags_if(ORDERED=order is not None)
            items, spread = tiles.tiles_of(count, rays)
            if order is None:
                return *shapes, launch("cast_tiles", flags, (items,), **common, spread=spread)
            return (
                *shapes,
                *order.launches(),
                launch("cast_tiles", flags, (items,), **common, order=order.order, spread=spread),
            )
        flags = with_lanes_flag(self.backend.info.lanes, "cast_ranges", flags)
        return *shapes, launch("cast_ranges", flags, (rays, count), **common)

    def _meet_shapes(
        self, placed: PlacedPoses, ray: Rays, rays: int, flags: frozenset[str], common: dict[str, Any]
    ) -> tuple[Program, bool]:
        """Return the launch that finds the distances of moving shapes, and whether it also casts the rays.

        Teams of work-items cast them; otherwise ranges contain the distances.
        """
        count, info = placed.count, self.backend.info
        parts = -(-rays // _RAYS_OF_TEAM)
        while count * parts < _ENOUGH_TEAMS and 64 * parts < rays:
            parts *= 2
        each = -(-rays // (64 * parts)) * 64
        items = count * -(-rays // each)
        kind = "cpu" if "FLOAT64" in flags or items > _MOST_TEAMS else info.kind
        teams, team = with_teams_flags(kind, "cast_among_shapes", flags, 1 << 30, self.backend.largest_group)
        arguments = {name: value for name, value in common.items() if name not in ("window", "ray")}
        arguments |= dict(ray=ray.ordered, turns=ray.turns)
        if team > 1:
            return (launch("cast_among_shapes", teams, (items * team,), **arguments, each=each),), True
        for name in ("map_table", "caster", "scale"):
            del arguments[name]
        flags &= {"SHAPES", "FLOAT64"}
        return (launch("meet_shapes", flags, (count,), **arguments, limit=self.limit),), False
