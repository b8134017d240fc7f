"""Expectation maximisation with the exact M-step, and Newton steps once EM becomes slow.

The book's M-step (table 6.2, lines 14 and 15) ignores the truncation of p_hit to [0, range_max] and of p_short to [0,
z*]. It does not maximise the likelihood, and may lower it. For the responsibilities r the exact M-step solves

    sum r W u^2 = sum r (1 - T)         sigma_hit: weighted squares are as large as for a truncated hit
    lambda sum r z = sum r (1 - v)      lambda_short: lengths are as large as for a truncated exponential

(W, T, v: see ``gpusense.reference.learning``). W is 1 for a normal. For Student's t, a normal with a random variance,
it is the expected inverse variance of a reading, the weight of its EM (Lange, Little and Taylor 1989). The logarithms
of both sides are nearly linear in log sigma and log lambda, so one Newton step of their difference is a good solution;
without truncation it is exact and equals the book's. The step is halved until the log-likelihood does not fall: a
generalised EM (Dempster, Laird and Rubin 1977, theorem 1).

EM is slow if causes are hard to distinguish. The same pass over the pairs yields the observed information; once EM
gains little, a Newton step of the log-likelihood is tried, and accepted if the log-likelihood rises.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from gpusense._util.typing import Floats
from gpusense.learning.beam.point import BIAS, FORM, HIT, RATE, SHORT, SIGMA, Point
from gpusense.learning.beam.problem import NOTHING, SMALL_FORM, Problem, Value
from gpusense.learning.information import newton_direction

# Longest step of a log shape.
_LONGEST = 2.0
# Newton steps begin once an EM step gains less than _LITTLE nats, or after _MANY EM steps.
_LITTLE, _MANY = 0.5, 20
_HALVINGS = 30
# Iterations without progress after which the search ends, for example at a kink where z* + b is clamped.
_STILL = 8
# Remaining gain [nats] below which a Newton step is accepted despite rounding.
_NEAR = 1e-4

Watch = Callable[[int, Value], None]


@dataclass
class Climb:
    """Result of a search."""

    value: Value
    trace: list[float]  # objectives at the start and after each iteration
    converged: bool  # whether the search ended at an optimum
    notes: list[str] = field(default_factory=list)  # remarks for the user


def climb_em(problem: Problem, start: Point, *, max_iterations: int, tolerance: float, watch: Watch) -> Climb:
    """Climb until the remaining gain, estimated from the information matrix, is at most ``tolerance`` nats."""
    value = problem.value(start)
    trace = [value.objective]
    # EM does not move the shape of hits: take only Newton steps, as long as they gain.
    has_form = bool(start.shape.limits)
    newton, gains, still = has_form, False, 0
    for iteration in range(1, max_iterations + 1):
        before = value.objective
        if not (has_form and gains):
            value = em_step(problem, value, second=newton)
        value = without_needless(problem, value)
        newton |= value.objective - before < _LITTLE or iteration >= _MANY
        left = math.inf
        if newton:
            if value.hessian is None:
                value = problem.value(value.point, second=True)
            old = value.objective
            value, left = newton_step(problem, value)
            gains = value.objective - old > problem.noise(value)
        trace.append(value.objective)
        watch(iteration, value)
        if left <= max(tolerance, problem.blur(value)):
            return Climb(value, trace, True)
        still = still + 1 if value.objective - before <= problem.noise(value) else 0
        if still == _STILL:
            return Climb(value, trace, False, [f"no progress, with {left:.2g} nats left to gain by the derivatives"])
    return Climb(value, trace, False, [f"no convergence within {max_iterations} iterations"])


def em_step(problem: Problem, value: Value, *, second: bool = False) -> Value:
    """Take one generalised EM step; the objective does not fall by more than rounding."""
    step = m_step(problem, value)
    weights = value.totals / problem.total
    for _ in range(_HALVINGS):
        candidate = problem.value(_shaped(problem, value.point, weights, step), second=second)
        if candidate.objective >= value.objective - problem.noise(value):
            return candidate
        step = step / 2
    return problem.value(_shaped(problem, value.point, weights, 0 * step), second=second)


def _shaped(problem: Problem, point: Point, weights: Floats, step: Floats) -> Point:
    """Return the point with new weights and moved shapes."""
    return replace(point.moved(step, problem.bounds), weights=weights)


def m_step(problem: Problem, value: Value) -> Floats:
    """Return the M-step of sigma, rate and offset, 0 for a cause without readings."""
    sums, point, prior = value.sums, value.point, problem.prior
    free = problem.free(value)
    step = np.zeros(FORM + len(point.shape.limits))
    pseudo, pseudo_squares = prior.of_hits(point)
    if value.totals[HIT] > NOTHING:
        squares = float(sums[11])
        likely = squares - sums[4]
        slope = -2 * squares - sums[7]
        step[SIGMA] = _log_step(squares + pseudo_squares, likely + pseudo, 2 + slope / max(likely + pseudo, 1e-300))
        curve = sums[9] + prior.curve_of_bias(point) * point.sigma**2
        if free[BIAS] and curve < 0:
            step[BIAS] = -value.gradient[BIAS] * point.sigma**2 / curve
    if free[RATE] or value.totals[SHORT] > NOTHING:
        count = float(prior.counts[SHORT])
        lengths = point.rate * sums[12]
        likely = sums[6] + lengths
        slope = sums[10] + lengths
        step[RATE] = _log_step(
            likely + count, lengths + count * point.rate / prior.rate, 1 - slope / max(likely + count, 1e-300)
        )
    return step


def _log_step(above: float, below: float, slope: float) -> float:
    """Return log(above / below) / slope, clamped to +-_LONGEST; +-_LONGEST if one side is 0."""
    if above <= 0 or below <= 0:
        return _LONGEST if above > below else -_LONGEST if above < below else 0.0
    rise = math.log(above) - math.log(below)
    return math.copysign(min(abs(rise) / max(slope, 1e-9), _LONGEST), rise)


def newton_step(problem: Problem, value: Value) -> tuple[Value, float]:
    """Take a Newton step if it raises the objective; also return the gain [nats] that the quadratic model predicted."""
    step, left = free_direction(problem, value)
    if left <= 0:
        return value, 0.0
    form = step[FORM:] / np.maximum(value.point.shape.coordinates, SMALL_FORM)
    longest = float(np.abs(np.append(step[: RATE + 1], form)).max())
    scale = min(1.0, _LONGEST / max(longest, 1e-300))
    # Near the optimum the step is right even if its gain is below rounding.
    least = value.objective - (problem.noise(value) if left < max(_NEAR, problem.blur(value)) else 0.0)
    for _ in range(5):
        candidate = problem.value(value.point.moved(scale * step, problem.bounds), second=True)
        if candidate.objective > least:
            return candidate, left
        scale /= 4
    return value, left


def free_direction(problem: Problem, value: Value) -> tuple[Floats, float]:
    """Return the Newton step along the free coordinates, and its predicted gain [nats]."""
    assert value.hessian is not None
    places = np.flatnonzero(problem.free(value))
    return newton_direction(value.gradient, value.hessian, places, 1e-12 * problem.total + 1e-300)


def without_needless(problem: Problem, value: Value) -> Value:
    """Set the weights of causes with hardly any reading to 0, unless the objective falls."""
    weights = value.point.weights
    for cause in range(4):
        if weights[cause] > 0 and value.totals[cause] < NOTHING and problem.prior.counts[cause] == 0:
            fewer = np.where(np.arange(4) == cause, 0, value.point.weights)
            point = replace(value.point, weights=fewer / fewer.sum())
            candidate = problem.value(point, second=value.hessian is not None)
            if candidate.objective >= value.objective - problem.noise(value):
                value = candidate
    return value
