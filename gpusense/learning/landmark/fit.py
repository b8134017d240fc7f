"""Fit standard deviations and weights of the landmark model to features at known poses.

``pairs`` computes the log-likelihood of features, and ``gpusense.learning.point.problem`` searches for its maximum.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from gpusense._util import checks
from gpusense._util.typing import Floats, Integers
from gpusense.learning.fitted import LandmarkFit, common_fields
from gpusense.learning.landmark.pairs import (
    FALSE,
    RANGE,
    RANGE_BIAS,
    SIGNATURE,
    Limits,
    Pairs,
    Value,
    evaluate,
    in_view,
    make_pairs,
    sensor_poses,
)
from gpusense.learning.point.problem import Climb, Problem, free_coordinates, maximize, of_weight, standard_errors
from gpusense.models.landmark.features import check_correspondence, check_features
from gpusense.world.landmarks import LandmarkMap
from gpusense.world.parameters import LandmarkParameters

SIGMAS = ("sigma_range", "sigma_bearing", "sigma_signature")
_BIASES = ("range_bias", "bearing_bias")
# A cause that accounts for fewer features than this counts as absent.
_NOTHING = 1e-3
# Smallest standard deviation as a share of range_max, of a radian, and of the signatures' span.
_SMALLEST = 1e-6


@dataclass(frozen=True, eq=False)
class _Features(Problem):
    """Likelihood of features by the coordinates of ``pairs``; parts that no feature has keep their start."""

    pairs: Pairs
    start: Floats
    fit_bias: bool

    @property
    def readings(self) -> int:
        return len(self.pairs.uniform)

    def part(self, every: int) -> _Features:
        return replace(self, pairs=self.pairs.every(every))

    def bounds(self) -> Floats:
        limits = np.concatenate([np.log(_limits(self.pairs)).T, [(0.0, 1.0)], [(-math.inf, math.inf)] * 2])
        free = [*self.pairs.measured, len(self.pairs.feature) > 0, self.fit_bias, self.fit_bias]
        return np.where(np.array(free)[:, None], limits, self.start[:, None])

    def scales(self, theta: Floats) -> Floats:
        return np.array([1.0, 1.0, 1.0, of_weight(theta[FALSE]), *np.exp(theta[:2])])

    def starts(self) -> list[Floats]:
        return [self.start]

    def log_p(self, theta: Floats) -> tuple[Floats, Floats]:
        value = evaluate(self.pairs, theta)
        return value.log_p, value.gradient

    def values(self, theta: Floats) -> dict[str, float]:
        values = dict(zip(SIGMAS, np.exp(theta[:FALSE]).tolist(), strict=True))
        values |= {"z_detect": 1 - float(theta[FALSE]), "z_false": float(theta[FALSE])}
        return values | dict(zip(_BIASES, theta[RANGE_BIAS:].tolist(), strict=True))


def _limits(pairs: Pairs) -> tuple[Floats, Floats]:
    """Return the (3,) smallest and (3,) largest standard deviations."""
    limits = pairs.limits
    lengths = np.array([limits.range_max, 1.0, limits.span[1] - limits.span[0]])
    return _SMALLEST * lengths, np.array([lengths[0], math.pi, lengths[2]])


def _first_guess(pairs: Pairs, initial: LandmarkParameters | None) -> Floats:
    """Make the start: the user's, or typical residuals of nearest landmarks and one false positive in ten."""
    low, high = _limits(pairs)
    if initial is not None:
        start = [getattr(initial, name) for name in SIGMAS]
        sigma = [float(np.clip(h / 10 if s is None else s, b, h)) for s, b, h in zip(start, low, high, strict=True)]
        false = 1 - min(max(initial.z_detect, 1e-6), 1 - 1e-6)
        return np.array([*np.log(sigma), false if len(pairs.feature) else 1.0, 0.0, 0.0])
    # Convert residuals across the line of sight to metres, the unit along it.
    distance = np.minimum(np.nan_to_num(pairs.means), pairs.limits.range_max)[:, RANGE]
    size = np.nan_to_num(pairs.residuals)
    size[:, 1] *= np.maximum(distance, 0.1)
    size[:, SIGNATURE] *= pairs.limits.range_max / max(high[SIGNATURE], 1e-300)
    order = np.lexsort(((size**2).sum(axis=1), pairs.feature))
    nearest = order[np.diff(pairs.feature[order], prepend=-1) > 0]
    with np.errstate(invalid="ignore"):
        typical = [
            1.4826 * float(np.median(np.abs(column[~np.isnan(column)]))) if (~np.isnan(column)).any() else high[k] / 10
            for k, column in enumerate(pairs.residuals[nearest].T)
        ]
    return np.array(
        [*np.log(np.clip(typical, np.maximum(low, 1e-3 * high), high)), 0.1 if len(pairs.feature) else 1.0, 0.0, 0.0]
    )


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
    base = LandmarkParameters(range_max=range_max, field_of_view=field_of_view, signature_span=signature_span)
    sightings = _sightings(poses, features, landmarks, correspondence, scan, base, mount)
    problem = _Features(sightings.pairs, _first_guess(sightings.pairs, initial), bias)
    end = maximize(problem, max_iterations, tolerance)
    base = base if initial is None else replace(base, p_detect=initial.p_detect)
    counts = None if scan is None else _count_detected(sightings, landmarks, evaluate(problem.pairs, end.theta))
    return _report(problem, end, sightings, base, counts)


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
    index = np.arange(len(full)) if scan is None else checks.indices("scan", scan, len(robots), (len(full),))
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


def _report(
    problem: _Features, end: Climb, sightings: Sightings, base: LandmarkParameters, counts: tuple[int, float] | None
) -> LandmarkFit:
    """Build the fit from the end of a search; ``counts`` are the landmarks in view, and the detected ones."""
    pairs, values, value = problem.pairs, problem.values(end.theta), evaluate(problem.pairs, end.theta)
    held = _held(pairs, values, value)
    errors = standard_errors(problem, end.theta, end.free)
    p_detect, errors["p_detect"] = _p_detect(counts, base.p_detect, held)
    # Offsets have errors even if they are not fitted.
    joint = replace(problem, fit_bias=True)
    offset_errors = standard_errors(joint, end.theta, free_coordinates(joint, end.theta))
    offsets: dict[str, Any] = {}
    for part, name in enumerate(_BIASES):
        known = pairs.measured[part] and value.responsibility.sum() > _NOTHING
        offset = values[name] if problem.fit_bias else _mean(pairs, value, part)
        offsets |= {name: offset if known else math.nan, f"{name}_error": offset_errors[name] if known else math.nan}
        if errors.pop(name) == math.inf:
            held[name] = "the readings do not determine it"
    expected, detected = counts or (0, 0.0)
    false = np.full(sightings.total, np.nan)
    false[sightings.indices] = value.false
    sigmas: dict[str, Any] = {name: values[name] if pairs.present[k] else None for k, name in enumerate(SIGMAS)}
    span = pairs.limits.span if pairs.present[SIGNATURE] else base.signature_span
    weights = {name: values[name] for name in ("z_detect", "z_false")}
    fields = common_fields(
        end.value, end.trace, end.converged, errors, held, _notes(pairs, value, end.converged),
        sightings.total - len(value.false),
    )  # fmt: skip
    fields["held"] |= {name: "no feature has this part" for name in SIGMAS if sigmas[name] is None}
    return LandmarkFit(
        parameters=replace(base, **sigmas, **weights, p_detect=p_detect, signature_span=span),
        **fields, **offsets, bias_fitted=problem.fit_bias, features=len(value.false),
        false_positives=float(value.false.sum()), expected=expected, detected=detected, false=false,
    )  # fmt: skip


def _p_detect(counts: tuple[int, float] | None, start: float, held: dict[str, str]) -> tuple[float, float]:
    """Return p_detect and its standard error; add the reason to ``held`` if it was not counted."""
    expected, detected = counts or (0, 0.0)
    if not expected:
        held["p_detect"] = "not counted: features were not given by scans" if counts is None else "no landmark in view"
        return start, math.nan
    p = min(detected / expected, 1.0)
    return p, math.sqrt(p * (1 - p) / expected)


def _mean(pairs: Pairs, value: Value, part: int) -> float:
    measured = ~np.isnan(pairs.residuals[:, part])
    weight = value.responsibility[measured]
    return float(weight @ pairs.residuals[measured, part] / weight.sum()) if weight.sum() > 0 else math.nan


def _held(pairs: Pairs, values: dict[str, float], value: Value) -> dict[str, str]:
    """Return the reasons why parameters have no standard error, by name."""
    held = {}
    low, high = _limits(pairs)
    detections = value.responsibility.sum() > _NOTHING
    for k, name in enumerate(SIGMAS):
        sigma = values[name]
        if not pairs.present[k]:
            continue
        if not detections:
            held[name] = "kept, since no feature is a landmark"
        elif not pairs.measured[k]:
            held[name] = "kept, since no landmark has this part"
        elif sigma <= low[k] * (1 + 1e-9):
            held[name] = f"at its lower bound {low[k]:.3g}: the residuals are zero"
        elif sigma >= high[k] * (1 - 1e-9):
            held[name] = f"at its upper bound {high[k]:.3g}: the residuals are as large as the limits of the sensor"
    z = values["z_detect"]
    if z in (0.0, 1.0):
        reason = "no feature is a false positive" if z == 1 else "every feature is a false positive"
        held["z_detect"] = held["z_false"] = reason
    return held


def _notes(pairs: Pairs, value: Value, converged: bool) -> list[str]:
    """Return the warnings of a fit."""
    notes = [] if converged else ["more iterations are needed"]
    used = np.unique(pairs.landmark[value.responsibility > 0.5])
    if len(used) == 1:
        notes.append(f"landmark {used[0]} alone was seen: an error of its position counts as an offset or as noise")
    count = sum(pairs.present) + 1
    if len(value.false) < count:
        notes.append(f"{len(value.false)} features cannot determine {count} parameters")
    return notes
