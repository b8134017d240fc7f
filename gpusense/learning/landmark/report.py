"""From where a search for the landmark model's parameters ended to what the user is told."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from gpusense.learning.landmark.em import NOTHING, SIGMAS, bounds_of, free
from gpusense.learning.landmark.pairs import BEARING_BIAS, ODDS, RANGE_BIAS, Floats, Integers, Pairs, Value, hessian
from gpusense.learning.landmark.result import LandmarkFit
from gpusense.world.parameters import LandmarkParameters

# Scaled information below this is none.
_FLAT = 1e-10


def report(
    pairs: Pairs, kept: Integers, total: int, value: Value, trace: list[float], converged: bool, bias: bool,
    base: LandmarkParameters, seen: tuple[int, float] | None,
) -> LandmarkFit:  # fmt: skip
    """The fit that ended at a value.

    Args:
        pairs: Of the features that say something.
        kept: Which of all features these are.
        total: Number of all features.
        value: The end.
        trace: Log-likelihoods on the way.
        converged: Whether the search came to rest.
        bias: Whether offsets were fitted.
        base: The limits, and p_detect where it cannot be counted.
        seen: Landmarks in view and those seen, or None.
    """
    point, count = value.point, len(value.false)
    second = hessian(pairs, point)
    own = _errors(second, free(pairs, value, bias))
    places = free(pairs, value, True)
    with_bias = _errors(second, places)
    parts = np.array(pairs.measured)
    held = _held(pairs, value)
    errors = {name: float(own[k] * point.sigma[k]) if parts[k] else math.nan for k, name in enumerate(SIGMAS)}
    errors["z_detect"] = errors["z_false"] = float(own[ODDS] * point.z_detect * (1 - point.z_detect))
    for name in errors:
        if errors[name] == math.inf:
            held[name] = "the features do not tell it"
    p, errors["p_detect"] = base.p_detect, math.nan
    expected, detected = seen or (0, 0.0)
    if expected:
        p = min(detected / expected, 1.0)
        errors["p_detect"] = math.sqrt(p * (1 - p) / expected)
    else:
        held["p_detect"] = "not counted: features were not given by scans" if seen is None else "no landmark in view"
    values: dict[str, Any] = {name: point.sigma[k] if pairs.given[k] else None for k, name in enumerate(SIGMAS)}
    span = pairs.limits.span if pairs.given[2] else base.signature_span
    parameters = replace(
        base, **values, z_detect=point.z_detect, z_false=1 - point.z_detect, p_detect=p, signature_span=span
    )
    biases = []
    for k, column in enumerate((RANGE_BIAS, BEARING_BIAS)):
        there = bool(parts[k]) and value.responsibility.sum() > NOTHING
        moved = point.bias[k] if bias or not there else _mean(pairs, value, k)
        biases += [moved if there else math.nan, float(with_bias[column]) if there else math.nan]
    false = np.full(total, np.nan)
    false[kept] = value.false
    return LandmarkFit(
        parameters=parameters,
        log_likelihood=value.log_likelihood,
        trace=np.array(trace),
        converged=converged,
        status="; ".join(_notes(pairs, value, converged, held)),
        standard_errors=errors,
        held=held,
        range_bias=biases[0],
        range_bias_error=biases[1],
        bearing_bias=biases[2],
        bearing_bias_error=biases[3],
        bias_fitted=bias,
        iterations=len(trace) - 1,
        features=count,
        missing=total - count,
        false_positives=float(value.false.sum()),
        expected=expected,
        detected=detected,
        false=false,
    )


def _errors(second: Floats, places: Integers) -> Floats:
    """(6,) standard errors along the coordinates; NaN where there is none, infinite where nothing is known."""
    errors = np.full(6, np.nan)
    if len(places):
        curve = -second[np.ix_(places, places)]
        scale = 1 / np.sqrt(np.maximum(np.abs(np.diag(curve)), 1e-300))
        size, axes = np.linalg.eigh(curve * np.outer(scale, scale))
        errors[places] = np.inf
        if size[0] > _FLAT:
            errors[places] = scale * np.sqrt((axes**2 / size).sum(axis=1))
    return errors


def _mean(pairs: Pairs, value: Value, part: int) -> float:
    """The mean residual of what is a landmark: what EM's next step would take for the offset."""
    there = ~np.isnan(pairs.residuals[:, part])
    weight = value.responsibility[there]
    return float(weight @ pairs.residuals[there, part] / weight.sum()) if weight.sum() > 0 else math.nan


def _held(pairs: Pairs, value: Value) -> dict[str, str]:
    """Why parameters have no standard error, by their names."""
    held = {}
    low, high = bounds_of(pairs)
    detections = value.responsibility.sum() > NOTHING
    for k, name in enumerate(SIGMAS):
        sigma = value.point.sigma[k]
        if not pairs.given[k]:
            held[name] = "no feature has this part"
        elif not detections:
            held[name] = "kept, since no feature is a landmark"
        elif not pairs.measured[k]:
            held[name] = "kept, since no landmark has this part"
        elif sigma <= low[k] * (1 + 1e-9):
            held[name] = f"at its lower bound {low[k]:.3g}: the residuals are zero"
        elif sigma >= high[k] * (1 - 1e-9):
            held[name] = f"at its upper bound {high[k]:.3g}: the residuals are as large as what can be measured"
    z = value.point.z_detect
    if z in (0.0, 1.0):
        which = "no feature is a false positive" if z == 1 else "every feature is a false positive"
        held["z_detect"] = held["z_false"] = which
    return held


def _notes(pairs: Pairs, value: Value, converged: bool, held: dict[str, str]) -> list[str]:
    """What is to be known of the fit."""
    notes = ["converged" if converged else "stopped: more iterations are needed"]
    used = np.unique(pairs.landmark[value.responsibility > 0.5])
    if len(used) == 1:
        notes.append(f"landmark {used[0]} alone was seen: an error of its position counts as an offset or as noise")
    count = sum(pairs.given) + 1
    if len(value.false) < count:
        notes.append(f"{len(value.false)} features cannot tell {count} parameters")
    notes += [f"{name}: {reason}" for name, reason in held.items() if reason != "no feature has this part"]
    return notes
