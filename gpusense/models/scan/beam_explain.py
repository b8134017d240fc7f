"""Build the text of ``BeamModel.explain()``."""

from __future__ import annotations

from collections.abc import Sequence

from gpusense.interface.plan import Omission, launch_omissions, scene_omissions, share
from gpusense.interface.terms import HIGH_PEAK
from gpusense.models.scan.beam_pipeline import BeamPipeline
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


def title_and_omissions(
    pipeline: BeamPipeline,
    last: LastCall,
    mixtures: Sequence[BeamParameters],
    incidence: IncidenceParameters | None,
    *,
    discrete: bool,
    unknown: str,
    weights_note: str,
) -> tuple[str, list[Omission]]:
    """Return the title of the report, and the omissions; readings and map as of the last call.

    Args:
        pipeline: The stages of the model.
        last: The last call.
        mixtures: Parameters of each bin of angles of incidence.
        incidence: The parameters by angle of incidence, or None.
        discrete: Whether the model is the table of a sensor.
        unknown: The rule for unknown cells.
        weights_note: Words of the title about weights of other programs.
    """
    caster, flags, scan = pipeline.caster, last.flags, last.scan
    scanner, real, weights = pipeline.scanner, pipeline.real.name, pipeline.setting.weights
    components = [(name, max(getattr(p, name) for p in mixtures), cost) for name, cost in _COSTS]
    omissions = scene_omissions(
        components=[] if discrete else components, mount=scanner.mount, unknown=unknown, outside=caster.outside,
        precision=real, ring=caster.method.ring,
    )  # fmt: skip
    if scan is not None and scan.shared:
        spared = len(scan.readings) - len(scan.rays)
        omissions.append(
            Omission(
                "repeated bearings",
                f"{len(scan.readings)} readings lie on {len(scan.rays)} rays",
                f"{share(spared, len(scan.readings))} of the ray casts",
            )
        )
    if flags and "ORIGINS_OUTSIDE" not in flags:
        omissions.append(Omission("entry from outside", "every beam starts inside the map", "a branch per ray"))
    if flags and "LINEAR" in flags and not discrete:
        omissions.append(
            Omission("log-domain sum", "z_rand bounds the mixture from below", "2 exp and 3 log per particle-beam")
        )
    if weights.is_peer:
        omissions.append(Omission("normalised density", f"compat='{weights.name}' sums cubes", "the likelihood"))
    else:
        omissions += _mixture_omissions(pipeline, discrete=discrete)
    omissions += launch_omissions(flags, LEAST_ORDERED if pipeline.backend.info.kind == "gpu" else None)
    if (far := caster.omission()) is not None:
        omissions.append(far)
    method = "" if caster.method.name == "exact" else f", ranges by {caster.method}"
    method += pipeline.cones.words(scanner.critical_incidence)
    if incidence is not None:
        method += f", parameters for {len(incidence.parameters)} ranges of the angle of incidence"
        method += " and for none" if incidence.no_surface is not None else ""
        method += " (max readings depend on it)" if pipeline.rules.max_depends else ""
    name = "beam model" if not discrete else "discrete beam model"
    return f"{name}{weights_note}{method}, {real}", omissions


def _mixture_omissions(pipeline: BeamPipeline, *, discrete: bool) -> list[Omission]:
    """Return the parts of the mixture that a table, parameters of 0, or a low peak make unnecessary."""
    mixture, cells = pipeline.mixture, pipeline.mixture.cells
    if discrete:
        steps = f"{cells + 1} x {cells + 1} steps of readings and expected ranges, no return included"
        return [Omission("mixture", f"the model is a table of {steps}", "all but 1 look-up a beam")]
    if mixture.table is not None:
        why = f"log p is tabulated over {cells} x {cells + 1} bins of readings and expected ranges"
        return [Omission("mixture", why, "all functions of the components, at the error of the bins")]
    omissions = [Omission(name, f"{name} = 0", cost) for flag, name, cost in _MOMENTS if flag not in mixture.flags]
    if "SHARP" not in mixture.flags:
        why = f"the hit density's peak is at most {HIGH_PEAK:g} / m"
        omissions.append(Omission("exponents in two parts", why, "37 operations"))
    return omissions
