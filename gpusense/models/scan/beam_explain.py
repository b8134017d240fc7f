"""Build the text of ``BeamModel.explain()``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gpusense.interface.plan import Omission, launch_omissions, scene_omissions, share
from gpusense.interface.terms import HIGH_PEAK
from gpusense.models.scan.tiles import LEAST_ORDERED
from gpusense.world.sensor_table import SensorTable

if TYPE_CHECKING:
    from gpusense.models.scan.beam import BeamModel


def title_and_omissions(model: BeamModel) -> tuple[str, list[Omission]]:
    """Return the title of the report, and the omissions; readings and map as of the last call."""
    costs = (
        ("z_hit", "1 exp, 2 erf and 1 division per particle-beam"),
        ("z_short", "1 exp, 1 tanh and 2 divisions per particle-beam"),
        ("z_rand", "1 addition per particle-beam"),
        ("z_max", "max readings altogether"),
    )
    discrete = isinstance(model._parameters, SensorTable)
    pipeline, flags = model._pipeline, model._last.flags
    cells = pipeline.mixture.cells
    components = [(name, max(getattr(p, name) for p in model._mixtures), cost) for name, cost in costs]
    components = [] if discrete else components
    omissions = scene_omissions(
        components=components, mount=model.scanner.mount, unknown=model.unknown, outside=model.outside,
        precision=model.precision, ring=model._caster.method.ring,
    )  # fmt: skip
    scan = model._last.scan
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
    if model.compat is not None:
        omissions.append(Omission("normalised density", f"compat='{model.compat}' sums cubes", "the likelihood"))
    elif discrete:
        steps = f"{cells + 1} x {cells + 1} steps of readings and expected ranges, no return included"
        omissions.append(Omission("mixture", f"the model is a table of {steps}", "all but 1 look-up a beam"))
    elif model.sensor_table is not None:
        why = f"log p is tabulated over {cells} x {cells + 1} bins of readings and expected ranges"
        omissions.append(Omission("mixture", why, "all functions of the components, at the error of the bins"))
    elif "SHARP" not in pipeline.mixture.flags:
        omissions.append(
            Omission("exponents in two parts", f"the hit density's peak is at most {HIGH_PEAK:g} / m", "37 operations")
        )
    omissions += launch_omissions(flags, LEAST_ORDERED if model.device.kind == "gpu" else None)
    if (far := model._caster.omission()) is not None:
        omissions.append(far)
    caster = model._caster.method
    how = "" if caster.name == "exact" else f", ranges by {caster}"
    how += pipeline.cones.words(model.scanner.critical_incidence)
    if model.incidence_parameters is not None:
        how += f", parameters for {len(model.incidence_parameters.parameters)} ranges of the angle of incidence"
        how += " and for none" if model.incidence_parameters.no_surface is not None else ""
        how += " (max readings depend on it)" if pipeline.rules.max_depends else ""
    name = "beam model" if not discrete else "discrete beam model"
    title = f"{name}{model._weights_note()}{how}, {model.precision}"
    return title, omissions
