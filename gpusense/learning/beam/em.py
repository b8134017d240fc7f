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
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from gpusense._util.typing import Floats
from gpusense.learning.beam.pairs import BIAS, FORM, HIT, RAND, RATE, SHORT, SIGMA, Point
from gpusense.learning.beam.problem import NOTHING, SMALL_FORM, Problem, Value
from gpusense.learning.fitted import scaled_axes

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
    return replace(point.moved(step, problem.bounds), weights=weights)


def m_step(problem: Problem, value: Value) -> Floats:
    """Return the M-step of sigma, rate and offset, 0 for a cause without readings."""
    sums, point, prior = value.sums, value.point, problem.prior
    free = problem.free(value)
    step = np.zeros(FORM + len(point.shape.limits))
    # Squares of pseudo-hits are as many as the pseudo-hits, plus the derivative by log sigma.
    (first, second), pseudo = prior.derivatives(point), float(prior.counts[HIT])
    if value.totals[HIT] > NOTHING:
        squares = float(sums[11])
        likely = squares - sums[4]
        slope = -2 * squares - sums[7]
        step[SIGMA] = _log_step(
            squares + first[SIGMA] + pseudo, likely + pseudo, 2 + slope / max(likely + pseudo, 1e-300)
        )
        curve = sums[9] + second[BIAS, BIAS] * point.sigma**2
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
    """Return the Newton step along the free coordinates, uphill even if not concave, and its predicted gain [nats]."""
    assert value.hessian is not None
    step, places = np.zeros(len(value.gradient)), np.flatnonzero(problem.free(value))
    scale, size, axes = scaled_axes(-value.hessian[np.ix_(places, places)], 1e-12 * problem.total + 1e-300)
    slope = axes.T @ (scale * value.gradient[places])
    along = slope / np.maximum(np.abs(size), 1e-9)
    step[places] = scale * (axes @ along)
    # Half the slope along the step.
    return step, 0.5 * float(slope @ along)


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


# Bound on a log weight relative to the largest one: weights are between e^-25 and e^25 times the largest weight.
_WIDEST = 25.0
# Largest number of rotations of the directions of a stuck hill climb.
_TURNS = 5


class _Search:
    """The objective as a function of the free coordinates, with the best value so far and the trace."""

    def __init__(self, problem: Problem, start: Point, watch: Watch) -> None:
        self.problem, self.watch = problem, watch
        self.best = problem.value(start)
        self.trace = [self.best.objective]
        self.restart()

    def restart(self) -> None:
        """Begin at the best point: logs of weights but the largest, and of shapes, and bias / range_max."""
        problem, self._start = self.problem, self.best.point
        used, bounds, self._at = self._start.weights > 0, problem.bounds, self._start.coordinates()
        free = np.append(used, [used[HIT], used[SHORT], problem.fit_bias and used[HIT]])
        largest = int(np.argmax(self._start.weights))
        free[largest] = False
        wide = [(self._at[largest] - _WIDEST, self._at[largest] + _WIDEST)] * 4
        limits = np.array([*wide, *np.log([bounds.sigma, bounds.rate]), (-bounds.bias, bounds.bias)])
        self.places = np.flatnonzero(free)
        self.unit = np.where(np.arange(FORM) == BIAS, problem.pairs.range_max, 1.0)[self.places]
        self.limits = limits[self.places] / self.unit[:, None]
        self.first = np.clip(self._at[self.places] / self.unit, *self.limits.T)

    def value(self, vector: Floats) -> Value:
        """Evaluate free coordinates, and remember the best value."""
        step = np.zeros(FORM)
        step[self.places] = vector * self.unit - self._at[self.places]
        value = self.problem.value(self._start.moved(step, self.problem.bounds))
        if value.objective > self.best.objective:
            self.best = value
        return value

    def cost(self, vector: Floats) -> float:
        """Return minus the objective per reading."""
        return -self.value(vector).objective / self.problem.total

    def cost_and_gradient(self, vector: Floats) -> tuple[float, Floats]:
        """Return minus the objective per reading and its gradient."""
        value = self.value(vector)
        return -value.objective / self.problem.total, -value.gradient[self.places] * self.unit / self.problem.total

    def end_iteration(self, *_: Any) -> None:
        """Append the best objective to the trace, and call the watch."""
        self.trace.append(self.best.objective)
        self.watch(len(self.trace) - 1, self.best)

    def stopped(self, tolerance: float) -> Climb:
        """Return the end of a search that gains nothing: an optimum if the quadratic model predicts no gain either."""
        self.best = without_needless(self.problem, self.problem.value(self.best.point, second=True))
        left = free_direction(self.problem, self.best)[1]
        if left <= max(1e3 * tolerance, self.problem.noise(self.best)):
            return Climb(self.best, self.trace, True)
        return Climb(self.best, self.trace, False, [f"no progress, with {left:.2g} nats left to gain"])


def climb_by_scipy(
    problem: Problem, start: Point, *, method: str, seed: int, max_iterations: int, tolerance: float, watch: Watch
) -> Climb:
    """Run a method of SciPy, restarted as long as it gains.

    ``"gradient"`` is L-BFGS-B (Byrd, Lu, Nocedal and Zhu 1995) with the analytic gradient. ``"genetic"`` puts
    differential evolution (Storn and Price 1997) over all the bounds before it.

    ``"hill_climb"`` is Powell's method (1964), without derivatives. Its line searches accept bounds and make progress
    in the long, narrow valleys of this likelihood, where a simplex (Nelder and Mead) collapses. The first directions
    are the coordinates. If no direction gains although derivatives exclude an optimum, the search restarts along
    randomly rotated directions.
    """
    search = _Search(problem, start, watch)
    if method == "hill_climb":
        return _restarted(search, {"xtol": 1e-4, "ftol": 1e-13}, max_iterations, tolerance, _TURNS)
    if method == "genetic" and len(search.places):
        _evolve(search, seed, max_iterations)
        max_iterations += len(search.trace)
    options = {"maxfun": 20 * max_iterations, "maxcor": 20, "ftol": 1e-15, "gtol": 1e-12}
    climb = _restarted(search, options, max_iterations, tolerance, None)
    if method == "genetic":
        climb.notes.append("the last steps are of method 'gradient'")
    return climb


def _restarted(
    search: _Search, options: dict[str, Any], max_iterations: int, tolerance: float, turns: int | None
) -> Climb:
    """Run L-BFGS-B, or Powell's method with up to ``turns`` rotations of its directions, as long as it gains."""
    from scipy.optimize import minimize

    rng, turned, powell = np.random.default_rng(0), False, turns is not None
    while len(search.trace) <= max_iterations:
        before = search.best.objective
        search.restart()
        size = len(search.places)
        if not size:
            return Climb(search.best, search.trace, True)
        # SciPy changes the directions in place.
        directions = np.linalg.qr(rng.normal(size=(size, size)))[0] if turned else np.eye(size)
        more = {"direc": directions} if powell else {}
        result = minimize(
            search.cost if powell else search.cost_and_gradient, search.first, jac=not powell,
            method="Powell" if powell else "L-BFGS-B", bounds=search.limits, callback=search.end_iteration,
            options=options | {"maxiter": max_iterations + 1 - len(search.trace)} | more,
        )  # fmt: skip
        if result.nit == 0:
            search.end_iteration()
        least = 10 * tolerance if powell else tolerance
        if search.best.objective - before <= max(least, search.problem.noise(search.best)):
            end = search.stopped(tolerance)
            if end.converged or not turns:
                return end
            turns, turned = turns - 1, True
    return Climb(search.best, search.trace, False, [f"no convergence within {max_iterations} iterations"])


def _evolve(search: _Search, seed: int, max_iterations: int) -> None:
    from scipy.optimize import differential_evolution

    # Weights far below one reading are left to L-BFGS-B.
    narrow = np.where(search.places <= RAND, math.log(10 * search.problem.total), math.inf)
    low, high = search.limits.T
    limits = np.stack([np.maximum(low, search.first - narrow), np.minimum(high, search.first + narrow)], axis=1)
    differential_evolution(
        search.cost, limits, x0=search.first, rng=seed,
        maxiter=max_iterations, popsize=10, tol=1e-6, atol=1e-9, polish=False, callback=search.end_iteration,
    )  # fmt: skip
