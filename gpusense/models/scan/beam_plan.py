"""What a beam model leaves out, and what it is called in its plan."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gpusense.interface.plan import Omission, launch_omissions, scene_omissions, share
from gpusense.interface.terms import HIGH_PEAK
from gpusense.models.cloud import LEAST_ORDERED

if TYPE_CHECKING:
    from gpusense.models.scan.beam import BeamModel


def title_and_omissions(model: BeamModel) -> tuple[str, list[Omission]]:
    """The model in words, and what it does not need; readings and map as of the last call."""
    costs = (
        ("z_hit", "1 exp, 2 erf and 1 division per particle-beam"),
        ("z_short", "1 exp, 1 tanh and 2 divisions per particle-beam"),
        ("z_rand", "1 addition per particle-beam"),
        ("z_max", "max readings altogether"),
    )
    components = [(name, max(getattr(p, name) for p in model._kinds), cost) for name, cost in costs]
    components = components if model._discrete is None else []
    omissions = scene_omissions(
        components=components, mount=model.scanner.mount, unknown=model.unknown, outside=model.outside,
        precision=model.precision, ring=model._caster.method.ring,
    )  # fmt: skip
    scan = model._last_scan
    if scan is not None and scan.shared:
        spared = len(scan.readings) - len(scan.rays)
        omissions.append(
            Omission(
                "repeated bearings",
                f"{len(scan.readings)} readings lie on {len(scan.rays)} rays",
                f"{share(spared, len(scan.readings))} of the ray casts",
            )
        )
    if model._last_code and "ORIGINS_OUTSIDE" not in model._last_code:
        omissions.append(Omission("entry from outside", "every beam starts inside the map", "a branch per ray"))
    if model._last_code and "LINEAR" in model._last_code and model._discrete is None:
        omissions.append(
            Omission("log-domain sum", "z_rand bounds the mixture from below", "2 exp and 3 log per particle-beam")
        )
    if model._peer is not None:
        omissions.append(Omission("normalised density", f"compat='{model.compat}' sums cubes", "the likelihood"))
    elif model._discrete is not None:
        steps = f"{model._cells + 1} x {model._cells + 1} steps of readings and expected ranges, no return included"
        omissions.append(Omission("mixture", f"the model is a table of {steps}", "all but 1 look-up a beam"))
    elif model.sensor_table is not None:
        why = f"log p is tabulated over {model._cells} x {model._cells + 1} bins of readings and expected ranges"
        omissions.append(Omission("mixture", why, "all functions of the components, at the error of the bins"))
    elif "SHARP" not in model._components:
        omissions.append(
            Omission("exponents in two parts", f"the hit density's peak is at most {HIGH_PEAK:g} / m", "37 operations")
        )
    omissions += launch_omissions(model._last_code, LEAST_ORDERED if model.device.kind == "gpu" else None)
    if (far := model._caster.omission()) is not None:
        omissions.append(far)
    caster = model._caster.method
    how = "" if caster.name == "exact" else f", ranges by {caster}"
    how += model._cones.words(model.scanner.critical_incidence)
    if model.incidence_parameters is not None:
        how += f", parameters for {len(model.incidence_parameters.parameters)} ranges of the angle of incidence"
        how += " and for none" if model.incidence_parameters.no_surface is not None else ""
        how += " (max readings depend on it)" if model._max_depends else ""
    name = "beam model" if model._discrete is None else "discrete beam model"
    title = f"{name}{model._peer_note()}{how}, {model.precision}, {model.device.selection} ({model.device.name})"
    return title, omissions
