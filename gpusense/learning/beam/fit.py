"""``fit_beam_parameters``: maximum-likelihood parameters of the beam model from readings and expected ranges."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike

from gpusense._util import checks
from gpusense.backends import Selection
from gpusense.learning.beam.book import climb_book
from gpusense.learning.beam.device_sums import DeviceSums
from gpusense.learning.beam.em import Climb, Watch, climb_em
from gpusense.learning.beam.options import Callback, Options, check_options, make_bounds, open_device, start_of
from gpusense.learning.beam.pairs import Pairs, make_pairs
from gpusense.learning.beam.point import Bounds, Point, first_guess, random_start
from gpusense.learning.beam.problem import NO_PRIOR, Prior, Problem, Value
from gpusense.learning.beam.report import report
from gpusense.learning.beam.result import BeamFit
from gpusense.learning.beam.searches import climb_genetic, climb_gradient, climb_hill
from gpusense.world.parameters import BeamParameters


def fit_beam_parameters(
    ranges: ArrayLike,
    expected: ArrayLike,
    range_max: float,
    *,
    method: str = "em",
    range_min: float = 0.0,
    initial: BeamParameters | None = None,
    backend: Selection = "auto",
    precision: str | None = None,
    max_iterations: int | None = None,
    tolerance: float = 1e-8,
    restarts: int = 0,
    seed: int = 0,
    range_bias: bool = False,
    responsibilities: bool = False,
    sigma_bounds: tuple[float, float] | None = None,
    lambda_bounds: tuple[float, float] | None = None,
    progress: bool = False,
    callback: Callback | None = None,
) -> BeamFit:
    """Learn the beam model's parameters: those that make the readings likeliest (book section 6.3.3, table 6.2).

    Readings are classed as by :func:`gpusense.classify`: missing ones are left out, "no return" has probability z_max,
    the others the mixture's density. The sums over pairs are taken on the device.

    Args:
        ranges: Readings z of any shape [m].
        expected: Expected ranges z* of the same shape, in [0, range_max] [m]; any value beside a missing reading.
        range_max: Readings of at least this are "no return" [m].
        method: ``"em"``: EM with the exact M-step and Newton steps; ``"em-book"``: the book's closed forms, with their
            failures; ``"gradient"``: L-BFGS-B; ``"hill_climb"``: Powell's method; ``"genetic"``: differential
            evolution, finished by gradients.
        range_min: Readings below this are missing [m].
        initial: Where to begin; a guess from the readings if None. A cause whose weight is 0 stays
            out; shapes beyond their bounds begin there.
        backend: Where it runs, see :func:`gpusense.devices`.
        precision: ``"float64"`` or ``"float32"``; None is float64 where the device has it.
        max_iterations: Most iterations of the method; None is 500 of EM, 60 of the book's, 1000 of the others.
        tolerance: The method has converged once it expects to gain less than this [nats].
        restarts: Further starts at random; the best end is returned.
        seed: Seed of these and of ``"genetic"``.
        range_bias: Also fit an offset b of correct ranges, z = z* + b. p_hit then has its mean at z* + b, held within
            [0, range_max].
        responsibilities: Also return each reading's probabilities of the four causes.
        sigma_bounds: Smallest and largest sigma_hit [m]. None is from the step that readings are rounded to, divided by
            sqrt(12), or else 1e-6 range_max, to range_max.
        lambda_bounds: Smallest and largest lambda_short [1/m]. None is 1e-3 / range_max to 1e4 / range_max.
        progress: Draw a progress bar on standard error where that is a terminal.
        callback: Called after each iteration with its number, the log-likelihood and the parameters.

    Returns:
        The fit.

    Raises:
        TypeError: an argument is not of the kind described.
        ValueError: a value breaks a rule above, the shapes differ, no reading says anything, the backend is absent, or
            the initial parameters make some reading impossible.
    """
    pairs = make_pairs(ranges, expected, range_max, range_min)
    options = check_options(
        method, max_iterations, tolerance, restarts, seed, range_bias, progress, callback, responsibilities
    )
    bounds = make_bounds(pairs, sigma_bounds, lambda_bounds)
    if initial is not None and not isinstance(initial, BeamParameters):
        raise TypeError(f"initial: must be BeamParameters, got {checks.show(initial)}")
    device = DeviceSums(*open_device(backend, precision), pairs)
    start = first_guess(pairs, bounds) if initial is None else start_of(initial, pairs, bounds)
    return fit_pairs(device, pairs, bounds, start, options)


def fit_pairs(
    device: DeviceSums, pairs: Pairs, bounds: Bounds, start: Point, options: Options, prior: Prior = NO_PRIOR
) -> BeamFit:
    """The best fit of several starts.

    Raises:
        ValueError: the start makes some reading impossible.
    """
    problem = Problem(device, pairs, bounds, prior, options.range_bias)
    rng = np.random.default_rng(options.seed)
    starts = [start, *(random_start(start, bounds, rng) for _ in range(options.restarts))]
    with _watcher(options, len(starts)) as watch:
        climbs = [_climb(problem, each, options, watch) for each in starts]
    best = max(climbs, key=lambda climb: climb.value.objective)
    return report(problem, best, options)


def _climb(problem: Problem, start: Point, options: Options, watch: Watch) -> Climb:
    if not math.isfinite(problem.value(start).objective):
        raise ValueError(f"initial: must make every reading possible, got {start.parameters()}")
    settings = {"max_iterations": options.max_iterations, "tolerance": options.tolerance, "watch": watch}
    match options.method:
        case "em":
            return climb_em(problem, start, **settings)  # type: ignore[arg-type]
        case "em-book":
            return climb_book(problem, start, **settings)  # type: ignore[arg-type]
        case "gradient":
            return climb_gradient(problem, start, **settings)  # type: ignore[arg-type]
        case "hill_climb":
            return climb_hill(problem, start, **settings)  # type: ignore[arg-type]
    return climb_genetic(problem, start, seed=options.seed, **settings)  # type: ignore[arg-type]


@contextlib.contextmanager
def _watcher(options: Options, starts: int) -> Iterator[Watch]:
    """What is called after each iteration: the user's function, and a bar on a terminal."""
    with contextlib.ExitStack() as stack:
        step = None
        if options.progress:
            from gpusense._util.progress import progress

            step = stack.enter_context(progress(options.max_iterations * starts))

        def watch(iteration: int, value: Value) -> None:
            if step is not None:
                step(f"{options.method}: log-likelihood {value.log_likelihood:.3f}")
            if options.callback is not None:
                options.callback(iteration, value.log_likelihood, value.point.parameters())

        yield watch
