"""``fit_beam_parameters``: maximum-likelihood parameters of the beam model from readings and expected ranges."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpusense import _checks
from gpusense.backends import Backend, get_backend
from gpusense.learning.book import climb_book
from gpusense.learning.device_sums import DeviceSums
from gpusense.learning.em import Climb, Watch, climb_em, newton_direction
from gpusense.learning.pairs import Pairs, make_pairs
from gpusense.learning.point import (
    BIAS,
    HIT,
    NAMES,
    RATE,
    SHORT,
    SIGMA,
    Bounds,
    Point,
    first_guess,
    possible_causes,
    random_start,
)
from gpusense.learning.problem import NO_PRIOR, NOTHING, Prior, Problem, Value
from gpusense.learning.result import BeamFit
from gpusense.learning.searches import climb_genetic, climb_gradient, climb_hill
from gpusense.learning.uncertainty import standard_errors
from gpusense.parameters import BeamParameters
from gpusense.scanner import Reading

METHODS = ("em", "em-book", "gradient", "hill_climb", "genetic")
Callback = Callable[[int, float, BeamParameters], object]

# By default sigma_hit is at least the deviation of rounding to the sensor's step, or this part of range_max.
_SMALLEST_SIGMA = 1e-6
# lambda_short range_max: from hardly distinguishable from uniform to readings within 1e-4 range_max.
_RATES = (1e-3, 1e4)


@dataclass(frozen=True)
class Options:
    """How a fit is made; see :func:`fit_beam_parameters`."""

    method: str
    max_iterations: int
    tolerance: float
    restarts: int
    seed: int
    range_bias: bool
    progress: bool
    callback: Callback | None
    responsibilities: bool


def fit_beam_parameters(
    ranges: ArrayLike,
    expected: ArrayLike,
    range_max: float,
    *,
    method: str = "em",
    range_min: float = 0.0,
    initial: BeamParameters | None = None,
    backend: str | Backend = "auto",
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
        raise TypeError(f"initial: must be BeamParameters, got {_checks.show(initial)}")
    device = DeviceSums(*open_device(backend, precision), pairs)
    start = first_guess(pairs, bounds) if initial is None else start_of(initial, pairs, bounds)
    return fit_pairs(device, pairs, bounds, start, options)


def check_options(
    method: str,
    max_iterations: int | None,
    tolerance: float,
    restarts: int,
    seed: int,
    range_bias: bool,
    progress: bool,
    callback: Callback | None,
    responsibilities: bool,
) -> Options:
    """The options of a fit, checked.

    Raises:
        TypeError, ValueError: as :func:`fit_beam_parameters`.
    """
    method = _checks.choice("method", method, METHODS)
    if max_iterations is None:
        max_iterations = {"em": 500, "em-book": 60}.get(method, 1000)
    if callback is not None and not callable(callback):
        raise TypeError(f"callback: must be callable, got {_checks.show(callback)}")
    for name, flag in (("range_bias", range_bias), ("progress", progress), ("responsibilities", responsibilities)):
        if not isinstance(flag, (bool, np.bool)):
            raise TypeError(f"{name}: must be True or False, got {_checks.show(flag)}")
    if method == "em-book" and range_bias:
        raise ValueError("range_bias: must be False with method 'em-book', which has no offset, got True")
    return Options(
        method,
        _checks.integer("max_iterations", max_iterations, low=1),
        _checks.real("tolerance", tolerance, above=0),
        _checks.integer("restarts", restarts, low=0),
        _checks.integer("seed", seed, low=0),
        bool(range_bias),
        bool(progress),
        callback,
        bool(responsibilities),
    )


def open_device(backend: str | Backend, precision: str | None) -> tuple[Backend, np.dtype]:
    """The device and the precision of its kernels."""
    opened = get_backend(backend)
    if precision is None:
        precision = "float64" if opened.info.float64 else "float32"
    real = np.dtype(_checks.choice("precision", precision, ("float64", "float32")))
    if real == np.float64 and not opened.info.float64:
        raise ValueError(f"precision: must be 'float32' on {opened.info.name}, which has no float64, got 'float64'")
    return opened, real


def make_bounds(
    pairs: Pairs, sigma: tuple[float, float] | None = None, rate: tuple[float, float] | None = None
) -> Bounds:
    """Bounds of the shapes: the user's, or those that the readings allow."""
    range_max = pairs.range_max
    smallest = max(pairs.quantum / math.sqrt(12), _SMALLEST_SIGMA * range_max)
    return Bounds(
        _bounds("sigma_bounds", sigma, (min(smallest, range_max), range_max)),
        _bounds("lambda_bounds", rate, (_RATES[0] / range_max, _RATES[1] / range_max)),
        range_max,
    )


def _bounds(name: str, given: tuple[float, float] | None, default: tuple[float, float]) -> tuple[float, float]:
    if given is None:
        return default
    low, high = _checks.array(name, given, (2,)).tolist()
    if not 0 < low <= high:
        raise ValueError(f"{name}: must be two numbers, 0 < smallest <= largest, got {_checks.show(given)}")
    return low, high


def start_of(initial: BeamParameters, pairs: Pairs, bounds: Bounds) -> Point:
    """Where a user's parameters begin: without the causes that no reading can have.

    Raises:
        ValueError: the causes that are left do not explain the readings.
    """
    point = bounds.hold(Point.of(initial))
    weights = np.where(possible_causes(pairs), point.weights, 0)
    if (pairs.hits and not weights[[0, 1, 3]].any()) or (pairs.max_readings and not weights[2]):
        raise ValueError(f"initial: must give every reading a cause, got {_checks.show(initial)}")
    return replace(point, weights=weights / weights.sum())


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
    return _result(problem, best, options)


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
            from gpusense.commands._common import progress

            step = stack.enter_context(progress(options.max_iterations * starts))

        def watch(iteration: int, value: Value) -> None:
            if step is not None:
                step(f"{options.method}: log-likelihood {value.log_likelihood:.3f}")
            if options.callback is not None:
                options.callback(iteration, value.log_likelihood, value.point.parameters())

        yield watch


def _result(problem: Problem, climb: Climb, options: Options) -> BeamFit:
    device, pairs = problem.device, problem.pairs
    value = problem.value(climb.value.point, second=True)
    held = _held(problem, value)
    errors = standard_errors(problem, value)
    bias, bias_error = _bias(problem, value)
    own = {name: errors[name] for name in NAMES[:BIAS]}
    notes = list(climb.notes)
    if not climb.converged and not notes:
        notes.append("did not converge")
    count = int((value.point.weights > 0).sum()) - 1 + int(value.point.weights[HIT] > 0)
    if problem.readings < count:
        notes.append(f"{problem.readings} readings cannot tell {count} parameters")
    for name, error in own.items():
        if error == math.inf:
            held[name] = "the readings do not tell it"
    notes += [f"{name}: {reason}" for name, reason in held.items()]
    head = "converged" if climb.converged else "stopped"
    return BeamFit(
        parameters=value.point.parameters(),
        log_likelihood=value.log_likelihood,
        trace=np.array(climb.trace),
        converged=climb.converged,
        status="; ".join([head, *notes]),
        standard_errors=own,
        held=held,
        range_bias=bias,
        range_bias_error=bias_error,
        bias_fitted=options.range_bias,
        iterations=len(climb.trace) - 1,
        passes=device.passes,
        hits=pairs.hits,
        max_readings=pairs.max_readings,
        missing=pairs.missing,
        outliers=round(float(value.sums[14])),
        method=options.method,
        precision=device.real.name,
        device=device.selection,
        responsibilities=_responsibilities(device, pairs, value.point) if options.responsibilities else None,
    )


def _held(problem: Problem, value: Value) -> dict[str, str]:
    """Why parameters were not free, by their names."""
    point, bounds = value.point, problem.bounds
    held = {}
    for cause in range(4):
        if point.weights[cause] == 0:
            held[NAMES[cause]] = "no reading needs this cause"
        elif point.weights[cause] == 1:
            held[NAMES[cause]] = "every reading has this cause"
    free = problem.free(value)
    shapes = ((SIGMA, HIT, point.sigma, bounds.sigma), (RATE, SHORT, point.rate, bounds.rate))
    for place, cause, now, (low, high) in shapes:
        if value.totals[cause] <= NOTHING:
            held[NAMES[place]] = f"kept, since {NAMES[cause]} accounts for no reading"
        elif not free[place]:
            side, bound = ("lower", low) if now <= low else ("upper", high)
            held[NAMES[place]] = f"at its {side} bound {bound:.3g}"
    return held


def _bias(problem: Problem, value: Value) -> tuple[float, float]:
    """The offset of correct ranges and its standard error; to first order where it was not fitted."""
    if value.totals[HIT] <= NOTHING:
        return value.point.bias, math.nan
    with_bias = Problem(problem.device, problem.pairs, problem.bounds, problem.prior, True)
    error = standard_errors(with_bias, value)[NAMES[BIAS]]
    if problem.fit_bias:
        return value.point.bias, error
    if math.isfinite(error):
        # One Newton step from 0 in all coordinates.
        return float(newton_direction(with_bias, value)[0][BIAS]), error
    return float(value.sums[12] / value.sums[1]) if value.sums[1] > 0 else 0.0, error


def _responsibilities(device: DeviceSums, pairs: Pairs, point: Point) -> NDArray[np.float64]:
    """(n, 4) of all readings in their order."""
    found = np.full((len(pairs.kinds), 4), np.nan)
    found[pairs.kinds == Reading.MAX] = [0, 0, 1, 0]
    _, hit, short, rand = device.causes(point).T
    found[pairs.places] = np.stack([hit, short, np.zeros_like(hit), rand], axis=1)
    return found
