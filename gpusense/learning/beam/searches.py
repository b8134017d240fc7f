"""Maximise the log-likelihood with SciPy: L-BFGS-B, Powell's method and differential evolution."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from gpusense._util.typing import Floats
from gpusense.learning.beam.em import Climb, Watch, free_direction, without_needless
from gpusense.learning.beam.point import BIAS, RAND, Point
from gpusense.learning.beam.problem import Problem, Value

# Bound on a log weight relative to the reference: weights are between e^-25 and e^25 times the reference weight.
_WIDEST = 25.0
# Largest number of rotations of the directions of a stuck hill climb.
_TURNS = 5


class _Coordinates:
    """The free coordinates of a search as a vector.

    They are the logarithms of the weights, log sigma_hit, log lambda_short and bias / range_max. The largest weight at
    the start, the reference, follows from the normalisation. Causes of weight 0 at the start stay excluded.
    """

    def __init__(self, problem: Problem, start: Point) -> None:
        self._problem, self._start = problem, start
        self._origin = start.coordinates()
        weights = start.weights
        reference = int(np.argmax(weights))
        free = np.append(weights > 0, [weights[0] > 0, weights[1] > 0, problem.fit_bias and weights[0] > 0])
        free[reference] = False
        self.places = np.flatnonzero(free)
        self.reference = reference
        bounds = problem.bounds
        shift = self._origin[reference]
        limits = [(shift - _WIDEST, shift + _WIDEST)] * 4
        limits += [(math.log(low), math.log(high)) for low, high in (bounds.sigma, bounds.rate)]
        limits.append((-bounds.bias, bounds.bias))
        self.unit = np.where(np.arange(7) == BIAS, problem.pairs.range_max, 1.0)[self.places]
        self.limits = np.array([limits[place] for place in self.places]).reshape(-1, 2) / self.unit[:, None]

    def vector(self, point: Point) -> Floats:
        """Return the free coordinates of a point, clamped to their limits."""
        logs = point.coordinates()
        logs[:4] += self._origin[self.reference] - logs[self.reference]
        return np.clip(logs[self.places] / self.unit, self.limits[:, 0], self.limits[:, 1])

    def point(self, vector: Floats) -> Point:
        """Return the point of free coordinates."""
        step = np.zeros(7)
        step[self.places] = vector * self.unit - self._origin[self.places]
        return self._start.moved(step, self._problem.bounds)


class _Search:
    """The objective as a function of a vector, with the best value so far and the trace."""

    def __init__(self, problem: Problem, start: Point, watch: Watch) -> None:
        self.problem, self.watch = problem, watch
        self.coordinates = _Coordinates(problem, start)
        self.best = problem.value(start)
        self.trace = [self.best.objective]

    def value(self, vector: Floats) -> Value:
        """Evaluate a vector, and remember the best value."""
        value = self.problem.value(self.coordinates.point(vector))
        if value.objective > self.best.objective:
            self.best = value
        return value

    def cost(self, vector: Floats) -> float:
        """Return minus the objective per reading."""
        return -self.value(vector).objective / self.problem.total

    def cost_and_gradient(self, vector: Floats) -> tuple[float, Floats]:
        """Return minus the objective per reading and its gradient."""
        value = self.value(vector)
        slope = value.gradient[self.coordinates.places] * self.coordinates.unit
        return -value.objective / self.problem.total, -slope / self.problem.total

    def end_iteration(self, *_: Any) -> None:
        """Append the best objective to the trace, and call the watch."""
        self.trace.append(self.best.objective)
        self.watch(len(self.trace) - 1, self.best)

    def left(self) -> float:
        """Return the remaining gain that the quadratic model predicts at the best point [nats]."""
        self.best = without_needless(self.problem, self.problem.value(self.best.point, second=True))
        return free_direction(self.problem, self.best)[1]

    def stopped(self, tolerance: float) -> Climb:
        """Return the end of a search that gains nothing: an optimum if the quadratic model predicts no gain either."""
        left = self.left()
        if left <= max(1e3 * tolerance, self.problem.noise(self.best)):
            return Climb(self.best, self.trace, True)
        return Climb(self.best, self.trace, False, [f"no progress, with {left:.2g} nats left to gain"])

    def exhausted(self, max_iterations: int) -> Climb:
        """Return the end of a search that took all iterations."""
        return Climb(self.best, self.trace, False, [f"no convergence within {max_iterations} iterations"])


def climb_gradient(problem: Problem, start: Point, *, max_iterations: int, tolerance: float, watch: Watch) -> Climb:
    """Run L-BFGS-B (Byrd, Lu, Nocedal and Zhu 1995) with the analytic gradient, restarted as long as it gains."""
    return _refine(_Search(problem, start, watch), max_iterations, tolerance)


def _refine(search: _Search, max_iterations: int, tolerance: float) -> Climb:
    from scipy.optimize import minimize

    coordinates = search.coordinates
    if not len(coordinates.places):
        return Climb(search.best, search.trace, True)
    while len(search.trace) <= max_iterations:
        before = search.best.objective
        result = minimize(
            search.cost_and_gradient,
            coordinates.vector(search.best.point),
            jac=True,
            method="L-BFGS-B",
            bounds=coordinates.limits,
            callback=search.end_iteration,
            options={
                "maxiter": max_iterations + 1 - len(search.trace),
                "maxfun": 20 * max_iterations,
                "maxcor": 20,
                "ftol": 1e-15,
                "gtol": 1e-12,
            },
        )
        gained = search.best.objective - before
        if result.nit == 0:
            search.end_iteration()
        if gained <= max(tolerance, search.problem.noise(search.best)):
            return search.stopped(tolerance)
    return search.exhausted(max_iterations)


def climb_hill(problem: Problem, start: Point, *, max_iterations: int, tolerance: float, watch: Watch) -> Climb:
    """Run Powell's method (1964), without derivatives, restarted until it gains nothing.

    Its line searches accept bounds and make progress in the long, narrow valleys of this likelihood, where a simplex
    (Nelder and Mead) collapses. The first directions are the coordinates. If no direction gains although derivatives
    exclude an optimum, the search restarts along randomly rotated directions.
    """
    from scipy.optimize import minimize

    search = _Search(problem, start, watch)
    coordinates = search.coordinates
    if not len(coordinates.places):
        return Climb(search.best, search.trace, True)
    rng = np.random.default_rng(0)
    directions, turns = np.eye(len(coordinates.places)), 0
    while len(search.trace) <= max_iterations:
        before = search.best.objective
        minimize(
            search.cost,
            coordinates.vector(search.best.point),
            method="Powell",
            bounds=coordinates.limits,
            callback=search.end_iteration,
            options={
                "maxiter": max_iterations + 1 - len(search.trace),
                "xtol": 1e-4,
                "ftol": 1e-13,
                # SciPy changes the directions in place.
                "direc": directions.copy(),
            },
        )
        if search.best.objective - before <= max(10 * tolerance, problem.noise(search.best)):
            end = search.stopped(tolerance)
            if end.converged or turns == _TURNS:
                return end
            turns += 1
            directions = np.linalg.qr(rng.normal(size=directions.shape))[0]
    return search.exhausted(max_iterations)


def climb_genetic(
    problem: Problem, start: Point, *, seed: int, max_iterations: int, tolerance: float, watch: Watch
) -> Climb:
    """Run differential evolution (Storn and Price 1997) over all the bounds, then L-BFGS-B."""
    from scipy.optimize import differential_evolution

    search = _Search(problem, start, watch)
    coordinates = search.coordinates
    if len(coordinates.places):
        # Weights far below one reading are left to L-BFGS-B.
        narrow = np.log(10 * problem.total)
        middle = coordinates.vector(start)
        limits = coordinates.limits.copy()
        for i, place in enumerate(coordinates.places):
            if place <= RAND:
                limits[i] = np.clip((middle[i] - narrow, middle[i] + narrow), *coordinates.limits[i])
        differential_evolution(
            search.cost,
            limits,
            x0=middle,
            rng=seed,
            maxiter=max_iterations,
            popsize=10,
            tol=1e-6,
            atol=1e-9,
            polish=False,
            callback=search.end_iteration,
        )
    climb = _refine(search, max_iterations + len(search.trace), tolerance)
    climb.notes.append("the last steps are of method 'gradient'")
    return climb
