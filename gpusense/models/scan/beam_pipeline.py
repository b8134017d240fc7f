"""The beam model on a device: its mixture, rays and ranges of readings, flags and launches."""

from __future__ import annotations

import math

import numpy as np

from gpusense.backends.base import Buffer
from gpusense.backends.workspace import Workspace
from gpusense.interface.constants import BLOCK_TERMS, strands_in
from gpusense.interface.flags import flags_if
from gpusense.interface.lanes import with_lanes_flag, with_loops_flag
from gpusense.interface.launches import Program, launch
from gpusense.interface.structs import MixtureTables
from gpusense.models.poses import PlacedPoses
from gpusense.models.scan.classed import ClassedScans
from gpusense.models.scan.cones import Cones
from gpusense.models.scan.map_caster import MapCaster
from gpusense.models.scan.mixture import Mixture
from gpusense.models.scan.pipeline import ScanLaunch, ScanPipeline, Tiles
from gpusense.models.scan.readings import ReadingLayout, Readings
from gpusense.models.scan.rules import ModelContext
from gpusense.models.scan.tiles import stranded, sum_launch, tiles_of
from gpusense.world.frames import ray_vectors


class BeamPipeline(ScanPipeline):
    """The stages of a beam model.

    ``max_evaluated``: True if max readings are evaluated by the mixture.
    """

    orders = True
    kernel_names = ("score_beams",), ("beam_tiles", "sum_parts")

    def __init__(
        self, context: ModelContext, caster: MapCaster, cones: Cones, mixture: Mixture, *, max_evaluated: bool
    ) -> None:
        super().__init__(context)
        self.caster, self.cones, self.mixture, self.map = caster, cones, mixture, caster.map
        self.rays_each = cones.rays
        # The rays of each beam, several for a cone.
        self.cone_vectors = ray_vectors(self.scanner.ray_bearings, self.scanner.mount)
        # If no range is possible, no component is left, but the kernel's code needs one.
        self._fixed_flags = (mixture.flags or frozenset({"RAND", "SINGLE"})) | flags_if(
            FLOAT64=self.real == np.float64, ALL_READINGS=max_evaluated or not self.specialize
        )
        upload, cells = self.backend.upload, mixture.cells
        self._cells = cells
        self._terms = upload(np.stack(mixture.terms, axis=1))
        self._constants = dict(
            terms=self._terms, masses=upload(mixture.masses), edges=upload(mixture.cosines.astype(self.real)),
            sensor=None if mixture.table is None else upload(mixture.table),
            tables=MixtureTables(mixture.bins, cells, cells / self.scanner.range_max),
            cone=cones.struct,
        )  # fmt: skip

    @property
    def _top(self) -> float:
        """Largest range of a table below a max reading: a range rounded to range_max remains a range."""
        if not self._cells:
            return math.inf
        return float(np.nextafter(self.real.type(self.scanner.range_max), self.real.type(0)))

    # ---- readings

    def upload(self, scans: ClassedScans, space: Workspace) -> Readings:
        """See ScanPipeline.upload; readings that share a ray are neighbours."""
        vectors = scans.rays if self.cones.rays == 1 else self.cone_vectors[scans.columns[scans.ray_offsets[:-1]]]
        values = scans.readings.astype(self.real)
        if self._cells:
            values = np.where(np.isfinite(scans.readings), np.minimum(values, self.real.type(self._top)), values)
        shared, several = scans.shared or not self.specialize, scans.scans > 1
        arrays = dict(ray=vectors.astype(self.real), reading=values)
        if several:
            arrays["constant_terms"] = (scans.constants + self.context.constant_term).astype(self.real)
        arguments = dict(zip(arrays, space.upload_all("scan", list(arrays.values())), strict=True))
        sums: dict[str, Buffer] = {}
        if several:
            begins = np.append(0, np.cumsum(scans.ray_counts)).astype(np.int32)
            sums["constant_terms"] = arguments.pop("constant_terms")
            arguments["start"], sums["counts"] = space.upload_all("scans", [begins, scans.counts.astype(np.int32)])
        if shared:
            arguments["first"] = space.upload("first", scans.ray_offsets)
        return Readings(
            scans.scans, scans.most_rays, scans.most_readings, flags_if(SHARED_RAYS=shared, SCANS=several),
            arguments, sums, float(scans.constants[0]) + self.context.constant_term,
            (scans.scans, scans.most_rays, scans.most_readings, len(scans.rays), len(scans.readings)),
        )  # fmt: skip

    def sensing(self) -> ReadingLayout:
        rules = self.rules
        vectors = rules.vectors[:, None] if self.cones.rays == 1 else self.cone_vectors
        return ReadingLayout(
            self.scanner, rules.beams, vectors, rules.z_max, end_points=False, max_depends=rules.max_depends,
            possible=self.context.possible, specialize=self.specialize, top=self._top, guard_scale=0.0, real=self.real,
        )  # fmt: skip

    def place_arguments(self, filled: dict[str, Buffer]) -> dict[str, Buffer]:
        return dict(ray=filled["point"], reading=filled["reading"])

    # ---- program

    def spread(self, particles: int, readings: Readings) -> int:
        return tiles_of(particles, readings.rays)[1]

    def conditions(self, readings: Readings, placed: PlacedPoses, tiles: Tiles | None) -> frozenset[str]:
        shared = "SHARED_RAYS" in readings.flags
        flags = self.caster.flags | flags_if(
            ORIGINS_OUTSIDE=not (self.specialize and placed.within(0)),
            ORDERED=tiles is not None and tiles.order is not None,
            STRANDED=tiles is not None and not shared and stranded(readings.rays, tiles.spread),
        )
        return flags if placed.inside is None else flags | placed.world_flags

    def flags(self, conditions: frozenset[str], *, tiled: bool, per_beam: bool) -> frozenset[str]:
        flags = self._fixed_flags | self.cones.flags | conditions
        if "SHARED_RAYS" in flags or not self.caster.method.stops:
            flags -= {"STOPS"}
        if tiled:
            return flags
        info, flags = self.backend.info, flags | flags_if(PER_BEAM=per_beam)
        return with_loops_flag(info.vector_loops, "score_beams", with_lanes_flag(info.lanes, "score_beams", flags))

    def layout(self, readings: Readings, flags: frozenset[str]) -> tuple[int, int]:
        if "STRANDED" in flags:
            return strands_in(readings.readings), 1
        return readings.readings, BLOCK_TERMS

    def score_launches(self, scoring: ScanLaunch) -> Program:
        placed, readings, parts, caster = scoring.placed, scoring.readings, self.parts(scoring), self.caster
        window, count = placed.frame.window, placed.count
        common = dict(
            map_table=scoring.table, normals=caster.normals(window, self.cones.flags), pose_cell=placed.cell,
            pose=placed.pose, window=window, particles=count, rays=readings.rays, readings=readings.readings,
            parts=parts.buffer, caster=caster.method.struct(), scale=caster.scale, batch=scoring.batch,
            **placed.places(), **self._constants, **readings.arguments,
        )  # fmt: skip
        if scoring.tiles is None:
            common |= self.numbers(scoring) | readings.constants
            return (launch("score_beams", scoring.flags, (count,), **common, log_p=scoring.log_p),)
        order = None if scoring.tiles.order is None else scoring.tiles.order.order
        items, spread = tiles_of(count, readings.rays)
        tiles = launch("beam_tiles", scoring.flags, (items,), **common, order=order, spread=spread)
        summing = sum_launch(
            scoring.flags | readings.sum_flags, count, parts, order=order, log_p=scoring.log_p, batch=scoring.batch,
            **readings.sums, **self.numbers(scoring),
        )  # fmt: skip
        return (tiles, summing) if readings.readings else (summing,)
