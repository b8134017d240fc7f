"""Expectation maximisation for the landmark model's parameters, and Newton steps once EM becomes slow.

The E-step computes the probability of each possible landmark of a feature, and of a false positive. The M-step weights
squared residuals by these probabilities. Its closed forms ignore the limits of the sensor, so a step is halved until
the log-likelihood does not fall. Once EM gains little, Newton steps of the log-likelihood follow, as for the beam
model (``gpusense.learning.beam.em``).
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from gpusense._util.typing import Floats, Integers
from gpusense.learning.information import newton_direction
from gpusense.learning.landmark.pairs import RANGE, RANGE_BIAS, SIGNATURE, Pairs, Point, Value, evaluate, hessian
from gpusense.models.landmark.features import wrapped
from gpusense.world.parameters import LandmarkParameters

SIGMAS = ("sigma_range", "sigma_bearing", "sigma_signature")
# A cause that accounts for fewer features than this counts as absent.
NOTHING = 1e-3
# Newton steps begin once an EM step gains less than _LITTLE nats, or after _MANY EM steps.
_LITTLE, _MANY = 0.5, 30
_HALVINGS = 30
# Newton steps omit pairs that are less probable after EM; their joint effect is below rounding.
_FAR = 1e-18
# Smallest standard deviation as a share of range_max, of a radian, and of the signatures' span.
_SMALLEST = 1e-6


def bounds_of(pairs: Pairs) -> tuple[Floats, Floats]:
    """Return the (3,) smallest and (3,) largest standard deviations."""
    limits = pairs.limits
    lengths = np.array([limits.range_max, 1.0, limits.span[1] - limits.span[0]])
    return _SMALLEST * lengths, np.array([lengths[0], math.pi, lengths[2]])


def first_guess(pairs: Pairs, initial: LandmarkParameters | None) -> Point:
    """Make the start from the user's parameters, or from the typical residual of each feature's nearest landmark.

    The default assumes one false positive in ten features.
    """
    low, high = bounds_of(pairs)
    if initial is not None:
        start = [getattr(initial, name) for name in SIGMAS]
        sigma = [float(np.clip(h / 10 if s is None else s, b, h)) for s, b, h in zip(start, low, high, strict=True)]
        z = min(max(initial.z_detect, 1e-6), 1 - 1e-6) if len(pairs.feature) else 0.0
        return Point((sigma[0], sigma[1], sigma[2]), z, (0.0, 0.0))
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
    sigma = np.clip(typical, np.maximum(low, 1e-3 * high), high).tolist()
    return Point((sigma[0], sigma[1], sigma[2]), 0.9 if len(pairs.feature) else 0.0, (0.0, 0.0))


def climb(
    pairs: Pairs, start: Point, bias: bool, max_iterations: int, tolerance: float
) -> tuple[Pairs, Value, list[float], bool]:
    """Climb until the remaining gain, estimated from the second derivatives, is at most ``tolerance`` nats.

    Returns the pairs of relevant probability, the final value, the log-likelihoods at the start and after each
    iteration, and whether the search converged.
    """
    value = evaluate(pairs, start)
    trace, newton = [value.log_likelihood], False
    for iteration in range(1, max_iterations + 1):
        before = value.log_likelihood
        value = _without_needless(pairs, _em_step(pairs, value, bias))
        left = math.inf
        if not newton and (value.log_likelihood - before < _LITTLE or iteration >= _MANY):
            newton, pairs = True, pairs.part(value.responsibility > _FAR)
            value = evaluate(pairs, value.point)
        if newton:
            value, left = _newton_step(pairs, value, bias)
        trace.append(value.log_likelihood)
        if left <= tolerance:
            return pairs, value, trace, True
    return pairs, value, trace, False


def _noise(value: Value) -> float:
    """Return the rounding error of a log-likelihood."""
    return 64 * float(np.finfo(float).eps) * (abs(value.log_likelihood) + len(value.false))


def _em_step(pairs: Pairs, value: Value, bias: bool) -> Value:
    """Take one generalised EM step; the log-likelihood does not fall by more than rounding."""
    point, r = value.point, value.responsibility
    z = float(np.clip(r.sum() / len(value.false), 0, 1))
    low, high = bounds_of(pairs)
    step = np.zeros(6)
    for part in range(3):
        measured = ~np.isnan(pairs.residuals[:, part])
        weight = r[measured]
        total = float(weight.sum())
        if total <= NOTHING:
            continue
        u = pairs.residuals[measured, part] - (point.bias[part] if part < 2 else 0.0)
        u = wrapped(u) if part == 1 else u
        if bias and part < 2:
            step[RANGE_BIAS + part] = float(weight @ u) / total
        spread = math.sqrt(float(weight @ (u - (step[RANGE_BIAS + part] if part < 2 else 0)) ** 2) / total)
        step[part] = math.log(min(max(spread, low[part]), high[part]) / point.sigma[part])
    for _ in range(_HALVINGS):
        candidate = evaluate(pairs, _clamped(pairs, replace(point.moved(step), z_detect=z)))
        if candidate.log_likelihood >= value.log_likelihood - _noise(value):
            return candidate
        step = step / 2
    return evaluate(pairs, replace(point, z_detect=z))


def _clamped(pairs: Pairs, point: Point) -> Point:
    """Return the point with its standard deviations clamped to their bounds."""
    sigma = np.clip(point.sigma, *bounds_of(pairs)).tolist()
    return replace(point, sigma=(sigma[0], sigma[1], sigma[2]))


def _without_needless(pairs: Pairs, value: Value) -> Value:
    """Remove a cause with hardly any feature, unless the log-likelihood falls."""
    for total, z in ((float(value.false.sum()), 1.0), (float(value.responsibility.sum()), 0.0)):
        if 0 < value.point.z_detect < 1 and total < NOTHING:
            candidate = evaluate(pairs, replace(value.point, z_detect=z))
            if candidate.log_likelihood >= value.log_likelihood - _noise(value):
                value = candidate
    return value


def free(pairs: Pairs, value: Value, bias: bool) -> Integers:
    """Return the indices of the coordinates that may move."""
    low, high = bounds_of(pairs)
    sigma = np.array(value.point.sigma)
    determined = np.array(pairs.measured) & (value.responsibility.sum() > NOTHING)
    inner = determined & (sigma > low * (1 + 1e-9)) & (sigma < high * (1 - 1e-9))
    odds = [0 < value.point.z_detect < 1]
    return np.flatnonzero(np.concatenate([inner, odds, determined[:2] & bias]))


def _newton_step(pairs: Pairs, value: Value, bias: bool) -> tuple[Value, float]:
    """Take a Newton step if it raises the log-likelihood; also return the predicted gain [nats]."""
    step, left = newton_direction(value.gradient, hessian(pairs, value.point), free(pairs, value, bias))
    if left <= 0:
        return value, 0.0
    scale = min(1.0, 1.0 / max(float(np.abs(step[:RANGE_BIAS]).max()), 1e-300))
    for _ in range(6):
        candidate = evaluate(pairs, _clamped(pairs, value.point.moved(scale * step)))
        if candidate.log_likelihood > value.log_likelihood:
            return candidate, left
        scale /= 4
    # A remaining gain below rounding counts as none.
    return value, min(left, 0.0) if left <= _noise(value) else left
