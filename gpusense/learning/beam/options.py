"""Check the options of a fit, open its device, and make its bounds and its start."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gpusense._util import checks
from gpusense.backends import Backend, Selection, get_backend
from gpusense.learning.beam.pairs import Pairs
from gpusense.learning.beam.point import Bounds, Point, possible_causes
from gpusense.world.parameters import BeamParameters

MOST_RESTARTS = 10_000
METHODS = ("em", "em-book", "gradient", "hill_climb", "genetic")
Callback = Callable[[int, float, BeamParameters], object]

# Default lower bound of sigma_hit as a share of range_max, if readings are not rounded to a larger step.
_SMALLEST_SIGMA = 1e-6
# Limits of a user's bounds, as multiples of the defaults.
_WIDEST = 1e-9, 1e9
# Default bounds of lambda_short range_max: nearly uniform, and readings within 1e-4 range_max.
_RATES = (1e-3, 1e4)


@dataclass(frozen=True)
class Options:
    """Options of a fit; see :func:`fit_beam_parameters`."""

    method: str
    max_iterations: int
    tolerance: float
    restarts: int
    seed: int
    range_bias: bool
    progress: bool
    callback: Callback | None
    responsibilities: bool = False


def check_options(**given: Any) -> Options:
    """Check the options of a fit; None as ``max_iterations`` becomes the method's default."""
    options = Options(**given)
    method = checks.choice("method", options.method, METHODS)
    if options.callback is not None and not callable(options.callback):
        raise TypeError(f"callback: must be callable, got {checks.show(options.callback)}")
    names = ("range_bias", "progress", "responsibilities")
    flags: dict[str, Any] = {name: checks.boolean(name, getattr(options, name)) for name in names}
    if method == "em-book" and flags["range_bias"]:
        raise ValueError("range_bias: must be False with method 'em-book', which has no offset, got True")
    most = {"em": 500, "em-book": 60}.get(method, 1000) if given["max_iterations"] is None else options.max_iterations
    return replace(
        options, **flags, max_iterations=checks.integer("max_iterations", most, low=1),
        tolerance=checks.real("tolerance", options.tolerance, above=0),
        restarts=checks.integer("restarts", options.restarts, low=0, high=MOST_RESTARTS),
        seed=checks.integer("seed", options.seed, low=0),
    )  # fmt: skip


def open_device(backend: Selection, precision: str | None) -> tuple[Backend, np.dtype]:
    """Open the device and choose the precision of its kernels."""
    opened = get_backend(backend)
    if precision is None:
        precision = "float64" if opened.info.float64 else "float32"
    real = np.dtype(checks.choice("precision", precision, ("float64", "float32")))
    if real == np.float64 and not opened.info.float64:
        raise ValueError(f"precision: must be 'float32' on {opened.info.name}, which has no float64, got 'float64'")
    return opened, real


def make_bounds(
    pairs: Pairs, sigma: tuple[float, float] | None = None, rate: tuple[float, float] | None = None
) -> Bounds:
    """Make the bounds of the shapes: the user's, or defaults from the readings."""
    range_max = pairs.range_max
    smallest = max(pairs.quantum / math.sqrt(12), _SMALLEST_SIGMA * range_max)
    return Bounds(
        _bounds("sigma_bounds", sigma, (min(smallest, range_max), range_max)),
        _bounds("lambda_bounds", rate, (_RATES[0] / range_max, _RATES[1] / range_max)),
        range_max,
    )


def _bounds(name: str, value: tuple[float, float] | None, default: tuple[float, float]) -> tuple[float, float]:
    if value is None:
        return default
    low, high = checks.array(name, value, (2,)).tolist()
    if not _WIDEST[0] * default[0] <= low <= high <= _WIDEST[1] * default[1]:
        least, most = (f"{factor * bound:.3g}" for factor, bound in zip(_WIDEST, default, strict=True))
        raise ValueError(
            f"{name}: must be two numbers, {least} <= smallest <= largest <= {most}, got {checks.show(value)}"
        )
    return low, high


def start_of(initial: BeamParameters, pairs: Pairs, bounds: Bounds, hit: str) -> Point:
    """Make the start of a search with normal hits from a user's parameters, without impossible causes."""
    if initial.hit not in ("normal", hit):
        raise ValueError(f"initial: hit must be 'normal' or that of the fit, {hit!r}, got {checks.show(initial)}")
    if initial.sigma_growth:
        raise ValueError(f"initial: sigma_growth must be 0, since it is not learned, got {checks.show(initial)}")
    point = bounds.hold(Point.of(initial.replace(hit="normal")))
    weights = np.where(possible_causes(pairs), point.weights, 0)
    if (pairs.hits and not weights[[0, 1, 3]].any()) or (pairs.max_readings and not weights[2]):
        raise ValueError(f"initial: must give every reading a cause, got {checks.show(initial)}")
    return replace(point, weights=weights / weights.sum())
