"""The book's EM as printed (table 6.2), for teaching and comparison; its failures are reported, not corrected."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from gpusense.learning.beam.em import Climb, Watch
from gpusense.learning.beam.point import HIT, SHORT, Point
from gpusense.learning.beam.problem import Problem, Value

# Beyond these, squares of a shape or of its inverse overflow.
_SMALLEST = 1e-150


def textbook_em(problem: Problem, start: Point, *, max_iterations: int, tolerance: float, watch: Watch) -> Climb:
    """Repeat lines 3 to 15 of table 6.2 until the log-likelihood changes by at most ``tolerance`` nats.

    sigma_hit and lambda_short follow the closed forms of the book, which ignore the components' normalisers; no bounds
    apply. The notes report steps in which the log-likelihood fell, and a shape that became 0, infinite or undefined;
    the result then has the last finite parameters.
    """
    value = problem.value(start)
    trace = [value.objective]
    falls, deepest = 0, 0.0
    notes: list[str] = []
    converged = False
    for iteration in range(1, max_iterations + 1):
        point = book_step(problem, value)
        broken = [
            f"{name} became {number:g} in iteration {iteration}, where the book's form ends"
            for name, number in (("sigma_hit", point.sigma), ("lambda_short", point.rate))
            if not _SMALLEST < number < 1 / _SMALLEST
        ]
        if broken:
            notes += broken
            break
        following = problem.value(point)
        change = following.objective - value.objective
        if not math.isfinite(following.objective):
            notes.append(f"the log-likelihood became {following.objective} in iteration {iteration}")
            break
        if change < -problem.noise(value):
            falls, deepest = falls + 1, max(deepest, -change)
        value = following
        trace.append(value.objective)
        watch(iteration, value)
        if abs(change) <= tolerance:
            converged = True
            break
    if falls:
        notes.append(f"the log-likelihood fell in {falls} of {len(trace) - 1} iterations, by up to {deepest:.3g} nats")
    if value.objective < max(trace):
        notes.append(f"the end is {max(trace) - value.objective:.3g} nats below the best iteration")
    return Climb(value, trace, converged, notes)


def book_step(problem: Problem, value: Value) -> Point:
    """Compute lines 10 to 15 of table 6.2; NaN for 0 / 0."""
    sums = value.sums
    with np.errstate(all="ignore"):
        sigma = value.point.sigma * math.sqrt(float(sums[11] / sums[1 + HIT])) if sums[1 + HIT] > 0 else math.nan
        rate = float(sums[1 + SHORT] / sums[12]) if sums[12] > 0 else math.nan
    return replace(value.point, weights=value.totals / problem.total, sigma=sigma, rate=rate)
