"""The beam model, *Probabilistic Robotics* section 6.3: cast, mixture and sum in one launch."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np

from gpusense._util import checks
from gpusense.backends import Selection
from gpusense.backends.base import Buffer
from gpusense.interface.lanes import widened
from gpusense.models.arguments import check_discrete
from gpusense.models.cloud import Cloud, Placed, all_within, ordered, stranded, tiles_of
from gpusense.models.scan.beam_plan import title_and_omissions
from gpusense.models.scan.bound import PlacedScan, Scene, Scorer
from gpusense.models.scan.caster import MapCaster
from gpusense.models.scan.cones import bins_of, cones_of, require_exact
from gpusense.models.scan.mixture import mixture_of, peer_mixture, tabulated
from gpusense.models.scan.model import ScanModel
from gpusense.models.scan.readings import Beams, PreparedScan
from gpusense.reference.error_free import BLOCK_TERMS, strands_in
from gpusense.tables import casters
from gpusense.tables.casters import Caster
from gpusense.world import compat as compat_module
from gpusense.world.frames import ray_vectors
from gpusense.world.grid import OccupancyGrid
from gpusense.world.parameters import BeamParameters, IncidenceParameters
from gpusense.world.scanner import Scanner
from gpusense.world.sensor_table import SensorTable
from gpusense.world.windows import Region


class BeamModel(ScanModel):
    """log p(z | x, m) of a scan by casting every beam of every particle.

    The mixture is ``z_hit p_hit + z_short p_short + z_max p_max + z_rand p_rand`` with a hit density that is truncated
    to [0, range_max] and renormalised (book equations 6.4 to 6.12).

    Args:
        grid: The map.
        scanner: The scanner's geometry.
        parameters: Weights and shapes of the mixture; or a :class:`DiscreteBeamModel`, the table of a sensor of the
            scanner's range_max, of which every beam is one look-up, max readings too.
        incidence: Instead of ``parameters``, those for each range of angles of incidence: between a beam and the normal
            of the wall that it hits, see ``RayCaster.incidence``. A beam that hits nothing has its ``no_surface``, or
            those of the first range. Where ``z_max`` differs between them, max readings depend on the pose, and are
            impossible where it is 0. Needs an exact caster.
        backend: Where it runs, see ``gpusense.devices()``; or a queue of pyopencl.
        precision: ``"float32"`` or ``"float64"``.
        caster: How expected ranges are found: ``"exact"`` (the default), another name of ``RayCaster.methods()``, or
            one of ``gpusense.casters`` with knobs of its own.
        sensor_table: None evaluates the mixture; a number tabulates log p over readings and expected ranges in bins of
            that width [m], at least range_max / 8192, as racing particle filters do.
        unknown: Whether unknown cells are ``"free"`` (the default) or ``"occupied"``.
        outside: Whether what lies outside the grid is ``"free"`` (the default) or ``"occupied"``.
        temperature: In (0, 1]: multiplies the sum over beams, which is overconfident because beams are not
            independent. 1 is the book's plain product.
        beams: Use only so many informative beams, evenly chosen, or the beams of these indices.
        compat: None, or ``"amcl"`` or ``"beluga"`` for the weights that these programs compute, with their defaults of
            parameters, caster, unknown and outside; see ``gpusense.compat``.
        specialize: False leaves nothing out: same numbers, slower.

    Raises:
        TypeError: an argument is of the wrong kind.
        ValueError: an argument breaks its rule, or the device is absent; the message names both.
    """

    def __init__(
        self,
        grid: OccupancyGrid,
        scanner: Scanner,
        parameters: BeamParameters | SensorTable | None = None,
        *,
        incidence: IncidenceParameters | None = None,
        backend: Selection = "auto",
        precision: str = "float32",
        caster: str | Caster | None = None,
        sensor_table: float | None = None,
        unknown: str | None = None,
        outside: str | None = None,
        temperature: float = 1.0,
        beams: Beams = None,
        compat: str | None = None,
        specialize: bool = True,
    ) -> None:
        peer = compat_module.choose(compat)
        default = BeamParameters() if peer is None else peer.beam
        self._discrete = parameters if isinstance(parameters, SensorTable) else None
        if self._discrete is not None:
            check_discrete(self._discrete, scanner, compat, sensor_table)
        # Of the mixture nothing is used where there is a discrete model.
        own: object = default if parameters is None or self._discrete is not None else parameters
        if not isinstance(own, BeamParameters):
            rule = "must be BeamParameters or a DiscreteBeamModel"
            raise TypeError(f"parameters: {rule}, got {checks.show(parameters)}")
        self.incidence_parameters = incidence
        # The parameters of each bin of angles of incidence.
        self._kinds: tuple[BeamParameters, ...] = (own,)
        cosines = np.zeros(1)
        if incidence is not None:
            if not isinstance(incidence, IncidenceParameters):
                raise TypeError(f"incidence: must be IncidenceParameters, got {checks.show(incidence)}")
            for name, value in (("parameters", parameters), ("sensor_table", sensor_table), ("compat", compat)):
                if value is not None:
                    raise ValueError(f"{name}: must be None with incidence, got {checks.show(value)}")
            self._kinds, cosines = bins_of(incidence)
        compat_module.check_weights(own, compat)
        if peer is not None:
            caster = "bresenham" if caster is None else caster
            unknown = "occupied" if unknown is None else unknown
            outside = peer.outside if outside is None else outside
            if sensor_table is not None:
                raise ValueError(f"sensor_table: must be None with compat, got {checks.show(sensor_table)}")
        method = casters.choose("caster", "exact" if caster is None else caster)
        super().__init__(
            grid, scanner, backend=backend, precision=precision, unknown=unknown, outside=outside,
            temperature=temperature, beams=beams, compat=compat, specialize=specialize,
            z_max=max(p.z_max for p in self._kinds) if self._discrete is None else 1.0, end_points=False,
        )  # fmt: skip
        self._max_depends = self._discrete is not None or len({p.z_max for p in self._kinds}) > 1
        self._cones = cones_of(scanner, method, incidence=incidence is not None)
        self._rays_each = self._cones.rays
        # The rays of each beam: one, or those of a cone.
        self._cone_vectors = ray_vectors(scanner.ray_bearings, scanner.mount)
        self._caster = MapCaster(
            self._backend, self._real, grid, scanner.mount, scanner.range_max, method,
            unknown=self.unknown, outside=self.outside, crop=specialize,
        )  # fmt: skip
        self._lead = 0.0 if peer is None else peer.beam_lead
        self.sensor_table = sensor_table
        self._components, self._terms = self._mixture()
        self._terms_there = self._backend.upload(self._terms)
        self._edges = self._backend.upload(cosines.astype(self._real))
        self._none = self._backend.upload(np.zeros(1, np.int32))
        # Where the readings of each ray begin while no rays are shared.
        self._one_each = self._backend.upload(np.arange(scanner.count + 1, dtype=np.int32))
        self._sensor, self._cells = self._tabulate(sensor_table)

    @property
    def parameters(self) -> BeamParameters | SensorTable:
        """Weights and shapes of the mixture, or the table of a sensor.

        Raises:
            AttributeError: they depend on the angle of incidence; see ``incidence_parameters``.
        """
        if self.incidence_parameters is not None:
            raise AttributeError("parameters: depend on the angle of incidence here, see incidence_parameters")
        return self._kinds[0] if self._discrete is None else self._discrete

    @property
    def table_bytes(self) -> int:
        """Bytes of the map's table on the device; 0 before the first call."""
        return self._caster.table_bytes

    def prepare(self, poses: object) -> None:
        """Make the map's table for a cloud of (N, 3) poses now; ``log_likelihood`` does it otherwise.

        Raises:
            TypeError, ValueError: poses that are not (N, 3) finite numbers.
            MemoryError: the device cannot hold the table.
        """
        self._caster.prepare(Cloud(poses, self._backend))

    def update_map(self, cells: object, region: object) -> None:
        """Replace cells of the map; afterwards every result is that of a model of the changed grid.

        With the exact caster only what can have changed is made anew; see ``RayCaster.update_map``.

        Args:
            cells: (h, w) integers as ``OccupancyGrid.cells``: occupancy in per cent, or -1 for unknown.
            region: (row, col) of the cell that ``cells[0, 0]`` replaces.

        Raises:
            TypeError, ValueError: cells or a region that are not integers, or do not fit the grid, or a look-up table
                from a file; nothing has changed.
        """
        with self._lock:
            self.grid = self._caster.update(cells, region)

    def expected_ranges(self, poses: object, *, out: Any = None) -> Any:
        """z* of every beam of the scanner at each pose; of a cone, the range of the nearest return.

        Args:
            poses: (N, 3) robot poses in the world [m, m, rad]; arrays of other libraries as in ``log_likelihood``.
            out: Where to write them, as in ``log_likelihood``.

        Returns:
            (N, K) metres in the model's precision; exactly range_max where nothing is nearer, or returns.

        Raises:
            TypeError, ValueError: poses that are not (N, 3) finite numbers.
        """
        with self._lock:
            return self._caster.cast(poses, self._cone_vectors, out, dataclasses.replace(self._cones, incidence=False))

    def incidence(self, poses: object, *, out: Any = None) -> Any:
        """The angle of incidence of every beam of the scanner at each pose; see ``RayCaster.incidence``.

        Args:
            poses: As for ``expected_ranges``.
            out: Where to write them, as in ``log_likelihood``.

        Returns:
            (N, K) radians in [0, pi / 2] in the model's precision, 0 head-on; of a cone, that of the ray with the
            nearest return. NaN where a beam has none.

        Raises:
            TypeError, ValueError: poses that are not (N, 3) finite numbers, or a caster that is not exact.
        """
        require_exact("caster", self._caster.method)
        with self._lock:
            return self._caster.cast(poses, self._cone_vectors, out, dataclasses.replace(self._cones, incidence=True))

    def explain(self) -> str:
        """What this scene does not need, why, and what leaving it out saves; readings and map as of the last call."""
        return str(self._plan(*title_and_omissions(self)))

    def _mixture(self) -> tuple[frozenset[str], np.ndarray]:
        """Flags of the components, and their numbers."""
        range_max, real = self.scanner.range_max, self._real
        if self._peer is not None:
            return peer_mixture(self._kinds[0], range_max, real, amcl=self.compat == "amcl")
        flags, terms = mixture_of(
            self._kinds, range_max, real, specialize=self._specialize, max_depends=self._max_depends
        )
        if self.sensor_table is not None:
            flags = (flags & {"LINEAR"}) | {"SENSOR_TABLE"}
        if self._discrete is not None:
            flags = frozenset({"SENSOR_TABLE"})
        return flags, terms

    def _tabulate(self, width: float | None) -> tuple[Buffer, int]:
        """The sensor's table on the device, and its number of bins; no table and 0 where the mixture is evaluated."""
        if self._discrete is not None:
            table = self._discrete.sensor_table(self._real)
            # Sums need no watch over impossible readings where there are none.
            self._components |= {"LINEAR"} if np.isfinite(table).all() else set()
            return self._backend.upload(table), self._discrete.bins
        if width is None:
            return self._backend.upload(np.zeros(1, self._real)), 0
        table = tabulated(self._kinds[0], width, self.scanner.range_max, self._real)
        return self._backend.upload(table), len(table) - 1

    def _impossible(self) -> bool:
        # Where max readings depend on the pose, the kernel tells.
        return not self._max_depends and all(p.z_hit == p.z_short == p.z_rand == 0 for p in self._kinds)

    def _prepare_launch(self, scan: PreparedScan) -> Callable[[Cloud, tuple[int, int], Buffer, bool], Buffer]:
        space, real, backend = self._workspace, self._real, self._backend
        # Readings that share a ray, the axis of their cones, share these.
        vectors = scan.rays if self._cones.rays == 1 else self._cone_vectors[scan.columns[scan.first[:-1]]]
        values = scan.readings.astype(real)
        if self._cells:
            # A range below range_max that is rounded to it is still a range, and no max reading to the table.
            top = np.nextafter(real.type(self.scanner.range_max), real.type(0))
            values = np.where(np.isfinite(scan.readings), np.minimum(values, top), values)
        batch, rays, readings = scan.batch, scan.most_rays, scan.most_readings
        shared = scan.shared or not self._specialize
        one_each = not shared if batch is not None else not scan.shared
        first = self._one_each if one_each else space.upload("first", scan.first)
        if batch is None:
            ray, reading = space.upload_all("scan", (vectors.astype(real), values))
            start, counts, fixed_of = self._none, self._none, self._terms_there
        else:
            ray, reading, fixed_of = space.upload_all("scan", (vectors.astype(real), values, self._fixed_of(batch)))
            start, counts = space.upload_all("scans", (batch.start, batch.counts))
        scans = 1 if batch is None else len(batch.counts)
        scalars = (scan.constant + self._lead, self.temperature)

        def launch(cloud: Cloud, part: tuple[int, int], result: Buffer, per_beam: bool) -> Buffer:
            table, region, corners = cloud.ensure(self._caster.map, *part)
            normals = self._caster.normals(region, self._cones.flags)
            mount, count = self.scanner.mount, part[1] - part[0]
            per_scan = count // scans
            poses = cloud.given(backend, space, part)
            flags = self._components | self._scene_flags() | self._caster.flags | self._cones.flags
            # A table has a row for max readings.
            evaluated = self._max_depends and self._discrete is None
            flags |= cloud.headings() | ({"ALL_READINGS"} if evaluated else set())
            flags |= {"SHARED_RAYS"} if shared else set()
            flags |= {"SCANS"} if batch is not None else set()
            inside = self._specialize and all_within(corners, self.grid, mount, region, 0)
            flags |= set() if inside else {"ORIGINS_OUTSIDE"}
            gpu = backend.info.kind == "gpu" and not per_beam
            if gpu:
                self._last_code = frozenset(flags)
                sizes = (count, per_scan, batch is None, rays, readings, len(scan.rays), len(scan.readings))
                if space.again(
                    (poses, result, table, first, normals), cloud.code(), self._caster.map.preparations, sizes, shared,
                    inside, scalars,
                ):  # fmt: skip
                    return None
            placed = cloud.place(backend, space, poses, part, (region, self.grid, mount), real, careful=False)
            world: tuple[Any, ...] = (region.rows, region.cols, count, rays, readings, len(self._kinds))
            world += (*self._cones.scalars, *self._caster.scalars, self._cells)
            world += (self._cells / self.scanner.range_max, self._caster.limit, self.grid.resolution)
            world += (self.scanner.range_max,)
            if gpu:
                order = ordered(backend, space, placed, count, rays, real)
                flags |= {"ORDERED"} if order is not None else set()
                self._last_code = frozenset(flags)
                order = self._none if order is None else order
                tiles, spread = tiles_of(count, rays)
                each, block = readings, BLOCK_TERMS
                if not shared and stranded(rays, spread):
                    self._last_code |= {"STRANDED"}
                    each, block = int(strands_in(readings)), 1
                parts = space.empty("parts", count * each, real)
                backend.compile("beam_tiles", self._last_code)(
                    (tiles,), table, normals, placed.cell, placed.pose, order, ray, first, reading, self._terms_there,
                    self._edges, self._sensor, start, parts, *world, 1, count, spread, per_scan,
                )  # fmt: skip
                backend.compile("sum_parts", self._last_code)(
                    (count,), parts, order, counts, fixed_of, result, count, each, block, 1, count, *scalars, per_scan,
                )  # fmt: skip
                space.keep()
                return parts
            flags |= {"PER_BEAM"} if per_beam else set()
            flags = self._last_code = widened(backend.info.lanes, "score_beams", flags)
            parts = space.empty("parts", count * readings if per_beam else 1, real)
            backend.compile("score_beams", flags)(
                (count,), table, normals, placed.cell, placed.pose, ray, first, reading, self._terms_there, self._edges,
                self._sensor, start, fixed_of, result, parts, *world, *scalars, per_scan, 0,
            )  # fmt: skip
            return parts

        return launch

    def _bound_scene(self) -> Scene:
        # A range below range_max that is rounded to it is still a range, and no max reading to a table.
        top = float(np.nextafter(self._real.type(self.scanner.range_max), self._real.type(0)))
        vectors = self._vectors[:, None] if self._cones.rays == 1 else self._cone_vectors
        return Scene(self._caster.map, vectors, top=top if self._cells else math.inf)

    def _bound_parts(self, count: int, places: int) -> tuple[int, int]:
        return (int(strands_in(places)), 1) if stranded(places, tiles_of(count, places)[1]) else (places, BLOCK_TERMS)

    def _bound_scorer(self, table: Buffer, region: Region) -> Scorer:
        normals, kinds = self._caster.normals(region, self._cones.flags), len(self._kinds)
        flags = self._components | self._scene_flags() | self._caster.flags | self._cones.flags
        # Where no range is possible at all there are none, but the code must say something of them.
        flags |= {"ALL_READINGS", "ORIGINS_OUTSIDE"} | (frozenset() if self._components else {"RAND", "SINGLE"})
        world = (*self._cones.scalars, *self._caster.scalars, self._cells, self._cells / self.scanner.range_max)
        world += (self._caster.limit, self.grid.resolution, self.scanner.range_max)

        def score(placed: Placed, headings: frozenset[str], count: int, scan: PlacedScan, parts: Buffer) -> None:
            tiles, spread = tiles_of(count, scan.places)
            own = {"STRANDED"} if scan.block == 1 else set()
            self._backend.compile("beam_tiles", frozenset(flags | headings | own))(
                (tiles,), table, normals, placed.cell, placed.pose, self._none, scan.point, self._one_each,
                scan.reading, self._terms_there, self._edges, self._sensor, self._none, parts, region.rows, region.cols,
                count, scan.places, scan.places, kinds, *world, 1, count, spread, count,
            )  # fmt: skip

        return score
