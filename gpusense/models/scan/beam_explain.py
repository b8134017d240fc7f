"""Build the text of ``BeamModel.explain()``: words about a scene, of which the model itself needs none."""

from __future__ import annotations

from collections.abc import Sequence

from gpusense.interface.constants import HIGH_PEAK
from gpusense.interface.plan import (
    Note,
    Omission,
    SceneNotes,
    component_notes,
    launch_omissions,
    precision_notes,
    share,
)
from gpusense.models.scan.beam_density import BeamDensity
from gpusense.models.scan.beam_pipeline import BeamPipeline
from gpusense.models.scan.mixture import hit_peak
from gpusense.models.scan.scoring import LastCall
from gpusense.models.scan.tiles import LEAST_ORDERED
from gpusense.world.parameters import BeamParameters, IncidenceParameters

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
