"""Fit the shape of hits jointly with all other parameters, on the device, from a fit with normal hits.

Student's t is a normal with a random inverse variance. EM with its expected value, the weight of the shape, has the
M-steps of a normal with weighted readings; as in ECME, the degrees of freedom move by Newton steps of the likelihood.

Source: Lange, Little and Taylor (1989), "Robust statistical modeling using the t distribution"; Liu and Rubin (1994),
"The ECME algorithm".
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from gpusense.learning.beam.device_sums import DeviceSums
from gpusense.learning.beam.em import Climb, climb_em
from gpusense.learning.beam.options import Options
from gpusense.learning.beam.pairs import Pairs
from gpusense.learning.beam.point import Bounds, Point
from gpusense.learning.beam.problem import NO_PRIOR, Problem, Value
from gpusense.learning.beam.report import report
from gpusense.learning.fitted import BeamFit
from gpusense.world.hit_shapes import SHAPES, HitName, shape_of
from gpusense.world.parameters import BeamParameters

# Number of readings for ranking the starts, and the remaining gain [nats] that suffices for the ranking.
_SAMPLE, _ROUGHLY = 20_000, 1e-2


def fit_shape(
    fit: BeamFit,
    device: DeviceSums,
    pairs: Pairs,
    bounds: Bounds,
    options: Options,
    hit: HitName,
    first: Point,
    initial: BeamParameters | None,
) -> BeamFit:
    """Fit the shape of hits as well, from a fit with normal hits."""
    kind = SHAPES[hit]
    if not pairs.hits or not pairs.expected.any():
        return without_ranges(fit, hit)
    normal = Point.of(fit.parameters)
    starts = [
        bounds.hold(replace(normal, sigma=factor * normal.sigma, shape=kind.at(np.array(shape))))
        for *shape, factor in kind.starts
    ]
    if initial is not None and initial.hit == hit:
        starts.append(replace(first, shape=shape_of(initial)))
    problem = Problem(device, pairs, bounds, NO_PRIOR, options.range_bias)
    sample = _sampled(problem)
    best = max((_climb(sample, start, options) for start in starts), key=lambda end: end.value.objective)
    start, known = best.value.point, best.trace[:-1] if sample is problem else []

    def watch(iteration: int, value: Value) -> None:
        if options.callback is not None:
            options.callback(fit.iterations + len(known) + iteration, value.log_likelihood, value.point.parameters())

    end = climb_em(problem, start, max_iterations=options.max_iterations, tolerance=options.tolerance, watch=watch)
    return report(problem, replace(end, trace=known + end.trace), options, start)


def without_ranges(fit: BeamFit, hit: HitName, growth: bool = False) -> BeamFit:
    """Return the fit of readings without a range: they determine neither the shape of hits nor its growth."""
    new, reason = ("sigma_growth",) * growth + SHAPES[hit].fitted, "no range determines it"
    return replace(
        fit, parameters=fit.parameters.replace(hit=hit), status=f"{fit.status}; {', '.join(new)}: {reason}",
        held=fit.held | dict.fromkeys(new, reason),
    )  # fmt: skip


def _sampled(problem: Problem) -> Problem:
    """Return the problem of a sample of the readings if there are many."""
    pairs = problem.pairs
    every = len(pairs.kinds) // _SAMPLE
    if every < 2:
        return problem
    some = pairs.subset(np.arange(len(pairs.kinds)) % every == 0)
    return Problem(problem.device.of(some), some, problem.bounds, problem.prior, problem.fit_bias)


def _climb(problem: Problem, start: Point, options: Options) -> Climb:
    """Search from a start until the starts can be ranked."""
    tolerance = max(options.tolerance, _ROUGHLY)
    return climb_em(
        problem, start, max_iterations=options.max_iterations, tolerance=tolerance, watch=lambda iteration, value: None
    )
