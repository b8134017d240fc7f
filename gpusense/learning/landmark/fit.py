"""Fit standard deviations and weights of the landmark model to features at known poses.

``pairs`` computes the log-likelihood, ``em`` maximises it, ``report`` and ``result`` describe the result.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from gpusense._util import checks
from gpusense._util.typing import Floats, Integers
from gpusense.learning.fitted import LandmarkFit
from gpusense.learning.information import errors_of
from gpusense.learning.landmark.em import NOTHING, SIGMAS, bounds_of, climb, first_guess, free
from gpusense.learning.landmark.pairs import (
    BEARING_BIAS,
    ODDS,
    RANGE_BIAS,
    Limits,
    Pairs,
    Value,
    hessian,
    in_view,
    make_pairs,
    sensor_poses,
)
from gpusense.models.landmark.features import check_correspondence, check_features
from gpusense.world.landmarks import LandmarkMap
from gpusense.world.parameters import LandmarkParameters


@dataclass(frozen=True)
class Sightings:
    """Checked arguments of a fit: features with at least one measured part, and the poses of all scans."""

    sensors: Floats  # (S, 3) poses of the sensor
    scan: Integers  # (F,) index of each feature's pose
    indices: Integers  # (F,) indices of these features among the caller's
    total: int  # number of the caller's features
    pairs: Pairs  # the features with their possible landmarks


def fit_landmark_parameters(
    poses: ArrayLike,
    features: ArrayLike,
    landmarks: LandmarkMap,
    *,
    correspondence: ArrayLike | None = None,
    scan: ArrayLike | None = None,
    range_max: float = 20.0,
    field_of_view: float = 2 * math.pi,
    signature_span: tuple[float, float] | None = None,
    mount: tuple[float, float, float] = (0.0, 0.0, 0.0),
    bias: bool = False,
    initial: LandmarkParameters | None = None,
    max_iterations: int = 300,
    tolerance: float = 1e-8,
) -> LandmarkFit:
    """Fit the parameters of the landmark model to features at known poses, by maximum likelihood (book section 6.6).

    A feature of known landmark j contributes ``log(z_detect p(f | j) + z_false p_uniform(f))``, as in
    ``LandmarkModel``. If the landmark is unknown, ``sum_j p(f | j) / V`` over the V landmarks in view from the pose
    replaces ``p(f | j)``. A known false positive contributes ``log(z_false p_uniform(f))``.

    Args:
        poses: (F, 3) pose of the robot for each feature, or (S, 3) with ``scan`` [m, m, rad].
        features: (F, 2) ranges [m] and bearings [rad], or (F, 3) with signatures; NaN for missing parts.
        landmarks: The map.
        correspondence: (F,) landmark of each feature, -1 for none; None if unknown.
        scan: (F,) index of each feature's pose. If set, landmarks in view are counted, even at poses without a
            feature, and p_detect is their detected share.
        range_max: Largest range of a feature [m].
        field_of_view: Field of view of the sensor, in (0, 2 pi] [rad].
        signature_span: Smallest and largest signature; None is the span of the map's and the features' signatures.
        mount: The sensor's pose (x, y, yaw) on the robot [m, m, rad].
        bias: Also fit offsets of ranges and bearings, so that they do not increase the standard deviations.
        initial: Start of the search; its limits are ignored. None guesses a start from the residuals.
        max_iterations: Largest number of iterations.
        tolerance: The search has converged once it expects to gain less than ``tolerance`` [nats].

    Returns:
        The fit.

    Raises:
        TypeError: An argument has the wrong type.
        ValueError: A value breaks a rule above, the shapes differ, a feature is outside the limits of the sensor, or no
            feature has a measured part.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> landmarks = gs.LandmarkMap([(5, 0)])
        >>> noise = np.random.default_rng(0).normal(0, (0.2, 0.05), (500, 2))
        >>> poses, features = np.zeros((500, 3)), np.array([5.0, 0.0]) + noise
        >>> fit = gs.fit_landmark_parameters(poses, features, landmarks, correspondence=np.zeros(500, int))
        >>> fit.converged, round(fit.parameters.sigma_range, 2), round(fit.parameters.sigma_bearing, 2)
        (True, 0.2, 0.05)
    """
    checks.instance("landmarks", landmarks, LandmarkMap)
    checks.instance("initial", initial, LandmarkParameters, optional=True)
    checks.boolean("bias", bias)
    most = checks.integer("max_iterations", max_iterations, low=1)
    least = checks.real("tolerance", tolerance, above=0)
    base = LandmarkParameters(range_max=range_max, field_of_view=field_of_view, signature_span=signature_span)
    sightings = _sightings(poses, features, landmarks, correspondence, scan, base, mount)
    start = first_guess(sightings.pairs, initial)
    pairs, value, trace, converged = climb(sightings.pairs, start, bias, most, least)
    counts = None if scan is None else _count_detected(replace(sightings, pairs=pairs), landmarks, value)
    base = base if initial is None else replace(base, p_detect=initial.p_detect)
    return report(pairs, sightings.indices, sightings.total, value, trace, converged, bias, base, counts)


def _sightings(
    poses: ArrayLike, features: ArrayLike, landmarks: LandmarkMap, correspondence: ArrayLike | None,
    scan: ArrayLike | None, base: LandmarkParameters, mount: tuple[float, float, float],
) -> Sightings:  # fmt: skip
    """Check the arguments of a fit, and pair the features with their possible landmarks."""
    map_signatures = landmarks.signatures
    with_signature = replace(base, sigma_signature=None if map_signatures is None else 1.0)
    full = check_features(features, with_signature, base.signature_span or (-math.inf, math.inf))
    x, y, yaw = (float(number) for number in checks.array("mount", mount, (3,), largest=checks.FARTHEST))
    robots = checks.array("poses", poses, (len(full) if scan is None else "S", 3), largest=checks.FARTHEST)
    index = np.arange(len(full)) if scan is None else checks.array("scan", scan, (len(full),), dtype=np.int64)
    bad = np.flatnonzero((index < 0) | (index >= len(robots)))
    if len(bad):
        raise ValueError(f"scan: indices must be in [0, {len(robots)}), got {index[bad[0]]} at index {bad[0]}")
    known = None if correspondence is None else check_correspondence(correspondence, len(full), len(landmarks))
    used = np.flatnonzero((~np.isnan(full)).any(axis=1))
    if not len(used):
        raise ValueError(f"features: must hold one with a measured part, got {len(full)} without")
    signatures = np.concatenate(
        [full[:, 2][~np.isnan(full[:, 2])], np.zeros(0) if map_signatures is None else map_signatures]
    )
    span = base.signature_span or (
        (float(signatures.min()), float(signatures.max())) if len(signatures) and np.ptp(signatures) > 0 else (0.0, 1.0)
    )
    limits = Limits(base.range_max, base.field_of_view / 2, span)
    sensors = sensor_poses(robots, (x, y, yaw))
    known = None if known is None else known[used]
    pairs = make_pairs(sensors[index[used]], full[used], landmarks.xy, map_signatures, known, limits)
    return Sightings(sensors, index[used], used, len(full), pairs)


def _count_detected(sightings: Sightings, landmarks: LandmarkMap, value: Value) -> tuple[int, float]:
    """Return the number of landmarks in view over all poses, and the expected number of detections."""
    pairs = sightings.pairs
    total = len(in_view(sightings.sensors, landmarks.xy, pairs.limits)[0])
    visible = pairs.in_view
    key = sightings.scan[pairs.feature[visible]] * len(landmarks) + pairs.landmark[visible]
    _, place = np.unique(key, return_inverse=True)
    with np.errstate(divide="ignore"):
        log_missed = np.bincount(place.ravel(), np.log1p(-np.minimum(value.responsibility[visible], 1)))
    return total, float((-np.expm1(log_missed)).sum())


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
    errors[places] = errors_of(-second[np.ix_(places, places)], np.eye(len(places)))
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
