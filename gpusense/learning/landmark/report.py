"""Build the user's result from the end of a search: parameters, standard errors and status."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from gpusense.learning.information import scaled_axes
from gpusense.learning.landmark.em import NOTHING, SIGMAS, bounds_of, free
from gpusense.learning.landmark.pairs import BEARING_BIAS, ODDS, RANGE_BIAS, Floats, Integers, Pairs, Value, hessian
from gpusense.learning.landmark.result import LandmarkFit
from gpusense.world.parameters import LandmarkParameters

# Scaled information below this counts as none.
_FLAT = 1e-10


def report(
    pairs: Pairs, indices: Integers, total: int, value: Value, trace: list[float], converged: bool, bias: bool,
    base: LandmarkParameters, counts: tuple[int, float] | None,
) -> LandmarkFit:  # fmt: skip
    """Build the fit from the end of a search."""
    second = hessian(pairs, value.point)
    held = _held(pairs, value)
    errors = _standard_errors(pairs, value, second, bias, held)
    p_detect, errors["p_detect"] = _p_detect(counts, base.p_detect, held)
    (range_bias, range_error), (bearing_bias, bearing_error) = _biases(pairs, value, second, bias)
    expected, detected = counts or (0, 0.0)
    false = np.full(total, np.nan)
    false[indices] = value.false
    return LandmarkFit(
        parameters=_parameters(pairs, value, base, p_detect),
        log_likelihood=value.log_likelihood,
        trace=np.array(trace),
        converged=converged,
        status="; ".join(_notes(pairs, value, converged, held)),
        standard_errors=errors,
        held=held,
        range_bias=range_bias,
        range_bias_error=range_error,
        bearing_bias=bearing_bias,
        bearing_bias_error=bearing_error,
        bias_fitted=bias,
        iterations=len(trace) - 1,
        features=len(value.false),
        missing=total - len(value.false),
        false_positives=float(value.false.sum()),
        expected=expected,
        detected=detected,
        false=false,
    )


def _parameters(pairs: Pairs, value: Value, base: LandmarkParameters, p_detect: float) -> LandmarkParameters:
    """Return the parameters of the model; a standard deviation is None if no feature has this part."""
    point = value.point
    values: dict[str, Any] = {name: point.sigma[k] if pairs.present[k] else None for k, name in enumerate(SIGMAS)}
    span = pairs.limits.span if pairs.present[2] else base.signature_span
    return replace(
        base, **values, z_detect=point.z_detect, z_false=1 - point.z_detect, p_detect=p_detect, signature_span=span
    )


def _standard_errors(pairs: Pairs, value: Value, second: Floats, bias: bool, held: dict[str, str]) -> dict[str, float]:
    """Return the standard errors of the fitted parameters by name; add the reasons of infinite ones to ``held``."""
    point, parts = value.point, pairs.measured
    along = _errors(second, free(pairs, value, bias))
    errors = {name: float(along[k] * point.sigma[k]) if parts[k] else math.nan for k, name in enumerate(SIGMAS)}
    errors["z_detect"] = errors["z_false"] = float(along[ODDS] * point.z_detect * (1 - point.z_detect))
    held |= {name: "the features do not determine it" for name, error in errors.items() if error == math.inf}
    return errors


def _p_detect(counts: tuple[int, float] | None, start: float, held: dict[str, str]) -> tuple[float, float]:
    """Return p_detect and its standard error; add the reason to ``held`` if it was not counted."""
    expected, detected = counts or (0, 0.0)
    if not expected:
        held["p_detect"] = "not counted: features were not given by scans" if counts is None else "no landmark in view"
        return start, math.nan
    p = min(detected / expected, 1.0)
    return p, math.sqrt(p * (1 - p) / expected)


def _biases(pairs: Pairs, value: Value, second: Floats, bias: bool) -> list[tuple[float, float]]:
    """Return the offsets of ranges and of bearings with their standard errors; NaN if not measured."""
    errors = _errors(second, free(pairs, value, True))
    biases = []
    for k, column in enumerate((RANGE_BIAS, BEARING_BIAS)):
        if pairs.measured[k] and value.responsibility.sum() > NOTHING:
            biases.append((value.point.bias[k] if bias else _mean(pairs, value, k), float(errors[column])))
        else:
            biases.append((math.nan, math.nan))
    return biases


def _errors(second: Floats, places: Integers) -> Floats:
    """Return (6,) standard errors along the coordinates; NaN outside ``places``, infinite without information."""
    errors = np.full(6, np.nan)
    if len(places):
        scale, size, axes = scaled_axes(-second[np.ix_(places, places)])
        errors[places] = np.inf
        if size[0] > _FLAT:
            errors[places] = scale * np.sqrt((axes**2 / size).sum(axis=1))
    return errors


def _mean(pairs: Pairs, value: Value, part: int) -> float:
    """Return the mean residual of features from landmarks: the offset of EM's next step."""
    measured = ~np.isnan(pairs.residuals[:, part])
    weight = value.responsibility[measured]
    return float(weight @ pairs.residuals[measured, part] / weight.sum()) if weight.sum() > 0 else math.nan


def _held(pairs: Pairs, value: Value) -> dict[str, str]:
    """Return the reasons why parameters have no standard error, by name."""
    held = {}
    low, high = bounds_of(pairs)
    detections = value.responsibility.sum() > NOTHING
    for k, name in enumerate(SIGMAS):
        sigma = value.point.sigma[k]
        if not pairs.present[k]:
            held[name] = "no feature has this part"
        elif not detections:
            held[name] = "kept, since no feature is a landmark"
        elif not pairs.measured[k]:
            held[name] = "kept, since no landmark has this part"
        elif sigma <= low[k] * (1 + 1e-9):
            held[name] = f"at its lower bound {low[k]:.3g}: the residuals are zero"
        elif sigma >= high[k] * (1 - 1e-9):
            held[name] = f"at its upper bound {high[k]:.3g}: the residuals are as large as the limits of the sensor"
    z = value.point.z_detect
    if z in (0.0, 1.0):
        reason = "no feature is a false positive" if z == 1 else "every feature is a false positive"
        held["z_detect"] = held["z_false"] = reason
    return held


def _notes(pairs: Pairs, value: Value, converged: bool, held: dict[str, str]) -> list[str]:
    """Return the parts of the status."""
    notes = ["converged" if converged else "stopped: more iterations are needed"]
    used = np.unique(pairs.landmark[value.responsibility > 0.5])
    if len(used) == 1:
        notes.append(f"landmark {used[0]} alone was seen: an error of its position counts as an offset or as noise")
    count = sum(pairs.present) + 1
    if len(value.false) < count:
        notes.append(f"{len(value.false)} features cannot determine {count} parameters")
    notes += [f"{name}: {reason}" for name, reason in held.items() if reason != "no feature has this part"]
    return notes
