"""The beam model on a device: its mixture, rays and ranges of readings, flags and launches; and its report."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from gpusense.backends.base import Buffer
from gpusense.backends.workspace import Workspace
from gpusense.interface.constants import BLOCK_TERMS, HIGH_PEAK, strands_in
from gpusense.interface.flags import flags_if
from gpusense.interface.lanes import with_lanes_flag, with_loops_flag
from gpusense.interface.launches import Program, launch
from gpusense.interface.plan import (
    Note,
    Omission,
    SceneNotes,
    component_notes,
    launch_omissions,
    precision_notes,
    share,
)
from gpusense.interface.structs import MixtureTables
from gpusense.models.poses import PlacedPoses
from gpusense.models.scan.classed import ClassedScans, ModelContext
from gpusense.models.scan.map_caster import Cones, MapCaster
from gpusense.models.scan.mixture import BeamDensity, Mixture, hit_peak
from gpusense.models.scan.pipeline import ScanLaunch, ScanPipeline, Tiles
from gpusense.models.scan.readings import ReadingLayout, Readings
from gpusense.models.scan.scoring import LastCall
from gpusense.models.scan.tiles import LEAST_ORDERED, stranded, sum_launch, tiles_of
from gpusense.world.frames import ray_vectors
from gpusense.world.parameters import BeamParameters, IncidenceParameters


class BeamPipeline(ScanPipeline):
    """The stages of a beam model (``max_evaluated``: True if max readings are evaluated by the mixture)."""

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
        vectors = self.rules.vectors[:, None] if self.cones.rays == 1 else self.cone_vectors
        return ReadingLayout(self.context, vectors, end_points=False, top=self._top)

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
        normals = caster.normals(window) if "INCIDENCE" in self.cones.flags else None
        common = dict(
            map_table=scoring.table, normals=normals, pose_cell=placed.cell,
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


# ---- build the text of ``BeamModel.explain()``: words about a scene, of which the model itself needs none


_COSTS = (
    ("z_hit", "1 exp, 2 erf and 1 division per particle-beam"),
    ("z_short", "1 exp, 1 tanh and 2 divisions per particle-beam"),
    ("z_rand", "1 addition per particle-beam"),
    ("z_max", "max readings altogether"),
)
_MOMENTS = (
    ("BIAS", "range_bias", "2 additions and 2 comparisons per particle-beam"),
    ("GROWTH", "sigma_growth", "1 division per particle-beam"),
)


def scene_notes(pipeline: BeamPipeline, last: LastCall, density: BeamDensity, weights_note: str) -> SceneNotes:
    """Return the report's title and the parts left out, kept, and removable, as of the last call."""
    flags, real, weights = last.flags, pipeline.real.name, pipeline.context.weights
    mixtures, discrete = density.mixtures, density.table is not None
    tabulated = discrete or pipeline.mixture.table is not None
    components = [(name, max(getattr(p, name) for p in mixtures), cost) for name, cost in _COSTS]
    omissions, kept = component_notes([] if discrete else components)
    kept_precision, could_go = precision_notes(real)
    kept += kept_precision
    if not (tabulated or weights.is_peer):
        mixture_kept, mixture_could_go = _kept_of_mixture(pipeline, mixtures)
        kept += mixture_kept
        could_go += mixture_could_go
    if "ORIGINS_OUTSIDE" in flags:
        kept.append(Note("entry from outside", "a beam starts outside the map, or may do so"))
    omissions += _ray_omissions(last)
    if flags and "LINEAR" in flags and not tabulated:
        omissions.append(
            Omission("log-domain sum", "z_rand bounds the mixture from below", "2 exp and 3 log per particle-beam")
        )
    if weights.is_peer:
        omissions.append(Omission("normalised density", f"compat='{weights.name}' sums cubes", "the likelihood"))
    else:
        omissions += _mixture_omissions(pipeline, discrete=discrete)
    omissions += launch_omissions(flags, LEAST_ORDERED if pipeline.backend.info.kind == "gpu" else None)
    if (far := pipeline.caster.omission()) is not None:
        omissions.append(far)
    name = "beam model" if not discrete else "discrete beam model"
    return SceneNotes(f"{name}{weights_note}{_method(pipeline, density.incidence)}, {real}", omissions, kept, could_go)


def _method(pipeline: BeamPipeline, incidence: IncidenceParameters | None) -> str:
    """Return the words of the title about ray casting, cones and angles of incidence."""
    method = "" if pipeline.caster.method.name == "exact" else f", ranges by {pipeline.caster.method}"
    method += pipeline.cones.words(pipeline.scanner.critical_incidence)
    if incidence is not None:
        method += f", parameters for {len(incidence.parameters)} ranges of the angle of incidence"
        method += " and for none" if incidence.no_surface is not None else ""
        method += " (max readings depend on it)" if pipeline.rules.max_depends else ""
    return method


def _ray_omissions(last: LastCall) -> list[Omission]:
    """Return the rays of the last call, or parts of them, that are not cast."""
    omissions, flags, scan = [], last.flags, last.scan
    if scan is not None and scan.shared:
        readings, rays = len(scan.readings), len(scan.rays)
        why = f"{readings} readings lie on {rays} rays"
        omissions.append(Omission("repeated bearings", why, f"{share(readings - rays, readings)} of the ray casts"))
    if flags and "ORIGINS_OUTSIDE" not in flags:
        entry = frozenset({"ORIGINS_OUTSIDE"})
        omissions.append(Omission("entry from outside", "every beam starts inside the map", "a branch per ray", entry))
    if "STOPS" in flags:
        why = "nothing beyond a reading and a few sigma_hit changes its density by a bit"
        omissions.append(Omission("rays behind readings", why, "the rest of these rays", ends=frozenset({"STOPS"})))
    return omissions


def _kept_of_mixture(pipeline: BeamPipeline, mixtures: Sequence[BeamParameters]) -> tuple[list[Note], list[Note]]:
    """Return the parts of the density that its parameters need, and the parts that other parameters would leave out."""
    flags, kept, could_go = pipeline.mixture.flags, [], []
    peak = max(hit_peak(p) for p in mixtures)
    if "LINEAR" not in flags:
        kept.append(Note("log-domain sum", "z_rand does not bound the mixture from below"))
    if "EXACT_EXPONENT" in flags:
        kept.append(Note("exponents in two parts", f"the hit density's peak is {peak:.4g} / m, above {HIGH_PEAK:g}"))
    if (hit := mixtures[0].hit) != "normal":
        kept.append(Note("shape of hits", f"hit = {hit!r}: a logarithm more, and masses from a table"))
    for flag, name, _ in _MOMENTS:
        if flag in flags:
            values = " or ".join(f"{value:g}" for value in sorted({getattr(p, name) for p in mixtures}))
            kept.append(Note(name, f"{name} = {values}"))
    if "INCIDENCE" in pipeline.cones.flags:
        kept.append(Note("angles of incidence", "they choose the parameters, or whether anything returns"))
    if "STOPS" not in flags and pipeline.specialize:
        why = "the density depends on z* however far behind the reading it is"
        kept.append(Note("rays behind readings", why))
        if max(p.z_short for p in mixtures) > 0 and len(mixtures) == 1:
            could_go.append(Note("rays behind readings", "z_short = 0 would end each ray behind its reading"))
    return kept, could_go


def _mixture_omissions(pipeline: BeamPipeline, *, discrete: bool) -> list[Omission]:
    """Return the parts of the mixture that a table, parameters of 0, or a low peak make unnecessary."""
    mixture, cells = pipeline.mixture, pipeline.mixture.cells
    if discrete:
        steps = f"{cells + 1} x {cells + 1} steps of readings and expected ranges, no return included"
        return [Omission("mixture", f"the model is a table of {steps}", "all but 1 look-up a beam")]
    if mixture.table is not None:
        why = f"log p is tabulated over {cells} x {cells + 1} bins of readings and expected ranges"
        return [Omission("mixture", why, "all functions of the components, at the error of the bins")]
    if "HIT" not in mixture.flags:
        # These parts go with the component.
        return []
    omissions = [
        Omission(name, f"{name} = 0", cost, frozenset({flag}))
        for flag, name, cost in _MOMENTS
        if flag not in mixture.flags
    ]
    if "EXACT_EXPONENT" not in mixture.flags:
        why = f"the hit density's peak is at most {HIGH_PEAK:g} / m"
        omissions.append(Omission("exponents in two parts", why, "37 operations", frozenset({"EXACT_EXPONENT"})))
    return omissions
