"""Fit the parameters of the beam model to readings and expected ranges, by maximum likelihood."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from gpusense._util import checks
from gpusense._util.progress import progress as progress_bar
from gpusense._util.typing import FitMethod, Precision
from gpusense.backends import Selection
from gpusense.learning.beam.device_sums import (
    Callback,
    DeviceSums,
    Options,
    check_options,
    make_bounds,
    open_device,
    start_of,
)
from gpusense.learning.beam.em import Climb, Watch, climb_by_scipy, climb_em
from gpusense.learning.beam.growth import fit_jointly, fit_shape
from gpusense.learning.beam.optimum import Search
from gpusense.learning.beam.pairs import HIT, SHORT, Bounds, Pairs, Point, first_guess, make_pairs, random_start
from gpusense.learning.beam.problem import NO_PRIOR, Prior, Problem, Value
from gpusense.learning.beam.report import report
from gpusense.learning.fitted import BeamFit
from gpusense.world.hit_shapes import SHAPES, HitName
from gpusense.world.parameters import BeamParameters

# Beyond these, squares of a shape or of its inverse overflow.
_SMALLEST = 1e-150


def fit_beam_parameters(
    ranges: ArrayLike,
    expected: ArrayLike,
    range_max: float,
    *,
    method: FitMethod = "em",
    range_min: float = 0.0,
    initial: BeamParameters | None = None,
    backend: Selection = "auto",
    precision: Precision | None = None,
    max_iterations: int | None = None,
    tolerance: float = 1e-8,
    restarts: int = 0,
    seed: int = 0,
    range_bias: bool = False,
    sigma_growth: bool = False,
    hit: HitName = "normal",
    responsibilities: bool = False,
    blocks: ArrayLike | None = None,
    sigma_bounds: tuple[float, float] | None = None,
    lambda_bounds: tuple[float, float] | None = None,
    progress: bool = False,
    callback: Callback | None = None,
) -> BeamFit:
    """Fit the parameters of the beam model by maximum likelihood (book section 6.3.3, table 6.2).

    :func:`gpusense.classify` classifies the readings: missing ones are ignored, "no return" has probability z_max, and
    ranges have the mixture's density. The device sums over all pairs.

    Args:
        ranges: Readings z of any shape [m].
        expected: Expected ranges z* of the same shape, in [0, range_max] [m]; ignored where the reading is missing.
        range_max: Readings of at least ``range_max`` are "no return" [m].
        method: ``"em"``: EM with the exact M-step and Newton steps; ``"em-book"``: the book's closed forms, with their
            failures; ``"gradient"``: L-BFGS-B; ``"hill_climb"``: Powell's method; ``"genetic"``: differential
            evolution, finished by gradients.
        range_min: Readings below ``range_min`` are missing [m].
        initial: Start of the search; None chooses the best of several from the readings. A cause of weight 0 stays
            excluded; shapes beyond their bounds are clamped. The status reports whether a start from the readings is
            better.
        backend: The device, see :func:`gpusense.devices`.
        precision: ``"float64"`` or ``"float32"``; None is float64 if the device has it.
        max_iterations: Largest number of iterations of the method; None is 500 for ``"em"``, 60 for ``"em-book"``, 1000
            for the rest.
        tolerance: The method has converged once it expects to gain less than ``tolerance`` [nats].
        restarts: Number of additional random starts, at most 10 000; the best result is returned.
        seed: Seed of the random starts and of ``"genetic"``.
        range_bias: Whether the parameters also contain an offset b of correct ranges: z = z* + b. p_hit then has its
            mean at z* + b, clamped to [0, range_max].
        sigma_growth: Whether the deviation of correct ranges grows with range, as sigma_hit + sigma_growth z*. All
            parameters are then fitted jointly on the host, starting from the fit without growth.
        hit: Shape of correct ranges: ``"normal"``, or ``"student"``, a Student t with fitted degrees of freedom
            ``hit_dof``. All parameters are then fitted jointly by EM and Newton steps, starting from the fit with a
            normal.
        responsibilities: Whether to also return each reading's probabilities of the four causes.
        blocks: Integer label of each reading's block, of the same shape, or None. Readings within a block (a scan, or
            neighbouring scans) may be correlated; blocks are independent. Standard errors are then computed over
            blocks.
        sigma_bounds: Smallest and largest sigma_hit [m]. The default is the rounding step of the readings over
            sqrt(12), or 1e-6 range_max without a step, to range_max.
        lambda_bounds: Smallest and largest lambda_short [1/m]. The default is 1e-3 / range_max to 1e4 / range_max.
        progress: Show a progress bar on standard error if that is a terminal.
        callback: Function called after each iteration with its number, the log-likelihood and the parameters.

    Returns:
        The fit.

    Raises:
        TypeError: An argument has the wrong type.
        ValueError: A value breaks a rule above, the shapes differ, every reading is missing, the backend is absent, or
            the initial parameters make a reading impossible.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> expected = np.full(1000, 4.0)
        >>> ranges = expected + np.random.default_rng(0).normal(0, 0.1, 1000)
        >>> fit = gs.fit_beam_parameters(ranges, expected, range_max=8.0, backend="numpy")
        >>> fit.converged, round(fit.parameters.sigma_hit, 3)
        (True, 0.098)
    """
    pairs = make_pairs(ranges, expected, range_max, range_min, blocks)
    options = check_options(
        method=method, max_iterations=max_iterations, tolerance=tolerance, restarts=restarts, seed=seed,
        range_bias=range_bias, progress=progress, callback=callback, responsibilities=responsibilities,
    )  # fmt: skip
    bounds = make_bounds(pairs, sigma_bounds, lambda_bounds)
    checks.instance("initial", initial, BeamParameters, optional=True)
    checks.boolean("sigma_growth", sigma_growth)
    checks.choice("hit", hit, tuple(SHAPES))
    if sigma_growth and method == "em-book":
        raise ValueError("sigma_growth: must be False with method 'em-book', which has no growth, got True")
    if hit != "normal" and method == "em-book":
        raise ValueError(f"hit: must be 'normal' with method 'em-book', as in the book, got {hit!r}")
    device = DeviceSums(*open_device(backend, precision), pairs)
    start = first_guess(pairs, bounds) if initial is None else start_of(initial, pairs, bounds, hit)
    fit = fit_pairs(device, pairs, bounds, start, options, chosen=initial is not None)
    if not sigma_growth:
        return fit if hit == "normal" else fit_shape(fit, device, pairs, bounds, options, hit, start, initial)
    return fit_jointly(fit, pairs, bounds, options.tolerance, options.responsibilities, hit)


def fit_pairs(
    device: DeviceSums,
    pairs: Pairs,
    bounds: Bounds,
    start: Point,
    options: Options,
    prior: Prior = NO_PRIOR,
    *,
    chosen: bool = False,
) -> BeamFit:
    """Fit pairs on a device from several starts, and report the best result."""
    problem = Problem(device, pairs, bounds, prior, options.range_bias)
    if not math.isfinite(problem.value(start).objective):
        raise ValueError(f"initial: must make every reading possible, got {start.parameters()}")
    rng = np.random.default_rng(options.seed)
    more = [random_start(start, bounds, rng) for _ in range(options.restarts)]
    with _watcher(options, 1 + len(more)) as watch:
        search = Search(problem, partial(_climb, options), watch)
        if options.method == "em-book":
            best = max(
                (search.method(problem, each, watch) for each in (start, *more)), key=lambda c: c.value.objective
            )
        else:
            best = search.run(start, more, chosen=chosen)
    return report(problem, best, options, start)


def _climb(options: Options, problem: Problem, start: Point, watch: Watch) -> Climb:
    settings: dict[str, Any] = dict(max_iterations=options.max_iterations, tolerance=options.tolerance, watch=watch)
    if options.method == "em" or start.shape.limits:
        return climb_em(problem, start, **settings)
    if options.method == "em-book":
        return textbook_em(problem, start, **settings)
    return climb_by_scipy(problem, start, method=options.method, seed=options.seed, **settings)


@contextlib.contextmanager
def _watcher(options: Options, starts: int) -> Iterator[Watch]:
    """Yield the function called after each iteration: it moves the progress bar and calls the user's callback."""
    with contextlib.ExitStack() as stack:
        step = None
        if options.progress:
            step = stack.enter_context(progress_bar(options.max_iterations * starts))

        def watch(iteration: int, value: Value) -> None:
            if step is not None:
                step(f"{options.method}: log-likelihood {value.log_likelihood:.3f}")
            if options.callback is not None:
                options.callback(iteration, value.log_likelihood, value.point.parameters())

        yield watch


def textbook_em(problem: Problem, start: Point, *, max_iterations: int, tolerance: float, watch: Watch) -> Climb:
    """Repeat lines 3 to 15 of table 6.2 until the log-likelihood changes by at most ``tolerance`` nats.

    sigma_hit and lambda_short follow the closed forms of the book, which ignore the components' normalisers; no bounds
    apply. The notes report steps in which the log-likelihood fell, and a shape that became 0, infinite or undefined;
    the result then has the last finite parameters.
    """
    value = problem.value(start)
    trace, notes, converged = [value.objective], list[str](), False
    for iteration in range(1, max_iterations + 1):
        point = book_step(problem, value)
        for name, number in (("sigma_hit", point.sigma), ("lambda_short", point.rate)):
            if not _SMALLEST < number < 1 / _SMALLEST:
                notes.append(f"{name} became {number:g} in iteration {iteration}, where the book's form ends")
        following = value if notes else problem.value(point)
        if not math.isfinite(following.objective):
            notes.append(f"the log-likelihood became {following.objective} in iteration {iteration}")
        if notes:
            break
        value, change = following, following.objective - value.objective
        trace.append(value.objective)
        watch(iteration, value)
        if abs(change) <= tolerance:
            converged = True
            break
    falls = -np.diff(trace)
    falls = falls[falls > problem.noise(value)]
    if len(falls):
        part = f"{len(falls)} of {len(trace) - 1} iterations"
        notes.append(f"the log-likelihood fell in {part}, by up to {max(falls):.3g} nats")
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
