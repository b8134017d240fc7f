"""The likelihood field on a device: its numbers, end points of readings, flags and launches."""

from __future__ import annotations

from typing import Any, cast

import numpy as np

from gpusense.backends.base import Buffer
from gpusense.backends.workspace import Workspace
from gpusense.interface.constants import BLOCK_TERMS
from gpusense.interface.flags import flags_if
from gpusense.interface.lanes import with_lanes_flag, with_loops_flag
from gpusense.interface.launches import Program, launch
from gpusense.interface.structs import FieldTerms, Score, packed
from gpusense.models.poses import PlacedPoses
from gpusense.models.scan.classed import ClassedScans, ModelContext
from gpusense.models.scan.pipeline import ScanLaunch, ScanPipeline, Tiles
from gpusense.models.scan.readings import ReadingLayout, Readings
from gpusense.models.scan.tiles import ENOUGH_SHORT, spread_of, sum_launch
from gpusense.tables.field import RING, FieldTable
from gpusense.tables.reachable import ReachableMap
from gpusense.tables.world_map import WorldMap, check_worlds
from gpusense.tables.worlds import Worlds
from gpusense.world.field_density import FieldDensity
from gpusense.world.grid import OccupancyGrid
from gpusense.world.parameters import LikelihoodFieldParameters

# Particles of a work-group of ``field_blocks`` or of vectors, as in the kernel file ``field``.
_GROUP = 64
# Distance from a cell's edge below which an end point is computed with more digits, in eps times its length + 2 cells.
_GUARD = 3.25
_NONE, _SCANS, _INSIDE = flags_if(), flags_if(SCANS=True), flags_if(INSIDE=True)


class FieldPipeline(ScanPipeline):
    """The stages of a likelihood field.

    ``components``: flags of the mixture; ``log_table``: whether cells hold log densities or cubes of densities, not
    distances; ``quick``: whether GPUs find cells in working precision, and use more digits only near edges of cells;
    ``guard``: distance from a cell's edge below which an end point needs more digits, by its length + 2 cells.
    """

    kept_parts = 1 / BLOCK_TERMS
    end_points = True
    kernel_names = ("score_field",), ("field_blocks", "sum_parts")

    def __init__(
        self,
        context: ModelContext,
        grid: OccupancyGrid | Worlds,
        parameters: LikelihoodFieldParameters,
        *,
        unknown: str,
        outside: str,
        shapes: bool = False,
    ) -> None:
        super().__init__(context)
        bilinear, weights = parameters.interpolation == "bilinear", context.weights
        # Distances to shapes are compared with those to walls.
        self.log_table = (self.specialize or weights.is_peer) and not bilinear and not shapes
        self.careful = self.real == np.float32
        self.quick = self.careful and self.log_table and self.specialize
        self.components, terms = self._mixture(parameters, bilinear=bilinear, cubes=context.cubes)
        self.terms = self.backend.upload(packed([terms], self.real))
        self.guard = _GUARD * float(np.finfo(self.real).eps)
        range_max = self.scanner.range_max
        self.table = FieldTable(
            self.real, parameters, grid.resolution, range_max, outside=outside,
            weights=weights, log_table=self.log_table, flags=self.components,
        )  # fmt: skip
        reach = (range_max + parameters.max_distance) / grid.resolution
        self._resolution = grid.resolution
        self.worlds = grid if isinstance(grid, Worlds) else None
        if isinstance(grid, Worlds):
            worlds = check_worlds(grid, self.backend)
            made = WorldMap(worlds, self.scanner.mount, lambda: self.table.of_worlds(worlds, unknown))
            self.map = cast(ReachableMap, made)
            return
        self.map = ReachableMap(
            self.backend, grid, unknown, self.scanner.mount, reach, self.table.make, self.specialize,
            self.table.refresh, obstacles_of=weights.field_obstacles, neighbors=weights.neighbors,
        )  # fmt: skip

    @property
    def table_bytes(self) -> int:
        """Bytes of the map's table on the device; 0 before it is made."""
        window = self.map.window
        if self.worlds is not None:
            return self.real.itemsize * self.worlds.cells
        return 0 if window is None else self.real.itemsize * (window.rows + 2 * RING) * (window.cols + 2 * RING)

    def _mixture(
        self, p: LikelihoodFieldParameters, *, bilinear: bool, cubes: bool
    ) -> tuple[frozenset[str], FieldTerms]:
        """Return flags of the mixture, and the numbers of the kernel file ``field``."""
        density, everything = FieldDensity(p, self.scanner.range_max), not self.specialize
        flags = flags_if(
            FLOAT64=not self.careful, TWO_PART_POINTS=self.careful, ALL_READINGS=everything, BILINEAR=bilinear,
            LOG_TABLE=self.log_table, CUBES=cubes, HIT=p.z_hit > 0 or everything, LINEAR=density.is_linear(self.real),
            EXACT_EXPONENT=not self.log_table and (density.is_sharp or everything),
            RAND=p.z_rand > 0 or everything,
        )  # fmt: skip
        return flags | density.flags, density.terms(self.real)

    # ---- readings

    def upload(self, scans: ClassedScans, space: Workspace) -> Readings:
        """See ScanPipeline.upload; a point is an end point in cells relative to the sensor."""
        cells = scans.readings / self._resolution
        lengths = cells
        if not self.specialize:
            # Missing and max readings have no length; their points hold nan and inf.
            finite = np.isfinite(cells)
            lengths = np.where(finite, cells, 0.0)
        # NumPy multiplies long rows in half the time of pairs.
        points = (scans.vectors.reshape(-1) * lengths.repeat(2)).reshape(-1, 2)
        high = points.astype(self.real)
        low = (points - high).astype(self.real)
        if not self.specialize:
            high[~finite] = cells[~finite, None]
        arrays = dict(point=high, point_low=low)
        if self.backend.info.kind == "gpu":
            longest = self._longest_of_blocks(lengths, scans)
            arrays["guard"] = (self.guard * (longest + 2)).astype(self.real)
        several = scans.scans > 1
        if several:
            arrays["constant_terms"] = (scans.constants + self.context.constant_term).astype(self.real)
        arguments = dict(zip(arrays, space.upload_all("points", list(arrays.values())), strict=True))
        sums: dict[str, Buffer] = {}
        if several:
            counts = [np.append(0, np.cumsum(scans.counts)), -(-scans.counts // BLOCK_TERMS)]
            sums["constant_terms"] = arguments.pop("constant_terms")
            arguments["start"], sums["counts"] = space.upload_all("scans", [one.astype(np.int32) for one in counts])
        return Readings(
            scans.scans, scans.most_rays, scans.most_readings, _SCANS if several else _NONE, arguments, sums,
            float(scans.constants[0]) + self.context.constant_term,
            (scans.scans, scans.most_readings, len(scans.readings)), lengths.item(lengths.argmax()) + 2,
        )  # fmt: skip

    def _longest_of_blocks(self, lengths: np.ndarray, scans: ClassedScans) -> np.ndarray:
        """Return the longest reading of each block, in cells; every scan has as many blocks as the longest scan."""
        if scans.scans == 1:
            return np.asarray(np.maximum.reduceat(lengths, np.arange(0, len(lengths), BLOCK_TERMS)))
        blocks = -(-scans.most_readings // BLOCK_TERMS)
        padded = np.zeros((scans.scans, blocks * BLOCK_TERMS))
        padded[np.arange(padded.shape[1]) < scans.counts[:, None]] = lengths
        return padded.reshape(scans.scans, blocks, BLOCK_TERMS).max(axis=2)

    def sensing(self) -> ReadingLayout:
        return ReadingLayout(self.context, self.rules.vectors[:, None], end_points=True, guard_scale=self.guard)

    def place_arguments(self, filled: dict[str, Buffer]) -> dict[str, Buffer]:
        return dict(point=filled["point"], point_low=filled["point_low"], guard=filled["guard"])

    # ---- program

    def spread(self, particles: int, readings: Readings) -> int:
        return spread_of(particles, -(-readings.readings // BLOCK_TERMS), ENOUGH_SHORT)

    def conditions(self, readings: Readings, placed: PlacedPoses, tiles: Tiles | None) -> frozenset[str]:
        if self.log_table and "SHAPES" in placed.world_flags:
            raise ValueError("shapes: must be assigned before a likelihood field is bound, got the first ones later")
        if placed.inside is not None and not self.quick:
            return placed.world_flags
        inside = tiles is not None and self.quick and placed.within(readings.reach, RING)
        flags = _INSIDE if inside else _NONE
        return flags if placed.inside is None else flags | placed.world_flags

    def flags(self, conditions: frozenset[str], *, tiled: bool, per_beam: bool) -> frozenset[str]:
        flags = self.components | conditions
        if not tiled:
            info, flags = self.backend.info, flags | flags_if(PER_BEAM=per_beam)
            flags = with_lanes_flag(info.lanes, "score_field", flags, float64=info.float64)
            flags = with_loops_flag(info.vector_loops, "score_field", flags)
        return flags | flags_if(ROUNDED_CELLS=self.quick and (tiled or self.backend.info.vector_loops))

    def layout(self, readings: Readings, flags: frozenset[str]) -> tuple[int, int]:
        return readings.readings if "PER_BEAM" in flags else -(-readings.readings // BLOCK_TERMS), 1

    def numbers(self, scoring: ScanLaunch) -> dict[str, Any]:
        """See ScanPipeline.numbers; blocks of readings have a guard each on the device."""
        readings = scoring.readings
        score = Score(readings.constant_term, self.context.temperature)
        # Error bounds: products of rounded factors err by at most 3.12 eps of the longest, their sums by 1.5 eps.
        return dict(score=score, guard=self.guard * readings.reach) if scoring.tiles is None else dict(score=score)

    def score_launches(self, scoring: ScanLaunch) -> Program:
        placed, readings, parts = scoring.placed, scoring.readings, self.parts(scoring)
        count = placed.count
        common = dict(
            table=scoring.table, pose_cell=placed.cell, pose=placed.pose, pose_low=placed.low, terms=self.terms,
            window=placed.frame.window, particles=count, readings=readings.readings, batch=scoring.batch,
            parts=parts.buffer, **placed.places(), **readings.arguments,
        )  # fmt: skip
        if scoring.tiles is None:
            # Lanes of a work-item are particles, which belong to one scan; lanes of loops are readings.
            grouped = readings.scans * -(-scoring.batch.per_scan // _GROUP) * _GROUP
            size = grouped if self.backend.info.lanes > 1 and "IN_LANES" in scoring.flags else count
            common |= self.numbers(scoring) | readings.constants
            return (launch("score_field", scoring.flags, (size,), **common, log_p=scoring.log_p),)
        items = (-(-count // _GROUP) << scoring.tiles.spread) * _GROUP
        blocks = launch("field_blocks", scoring.flags, (items,), **common, spread=scoring.tiles.spread)
        summing = sum_launch(
            scoring.flags | readings.sum_flags, count, parts, log_p=scoring.log_p,
            batch=scoring.batch, **readings.sums, **self.numbers(scoring),
        )  # fmt: skip
        return (blocks, summing) if readings.readings else (summing,)
