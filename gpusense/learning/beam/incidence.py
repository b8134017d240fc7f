"""``fit_incidence_parameters``: beam parameters by angle of incidence, thin bins leaning on the whole."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpusense._util import checks
from gpusense.backends import Selection
from gpusense.learning.beam.device_sums import DeviceSums
from gpusense.learning.beam.fit import fit_pairs
from gpusense.learning.beam.options import Callback, check_options, make_bounds, open_device, start_of
from gpusense.learning.beam.pairs import Pairs, make_pairs
from gpusense.learning.beam.point import Point, first_guess
from gpusense.learning.beam.problem import Prior
from gpusense.learning.beam.result import BeamFit
from gpusense.world.parameters import BeamParameters, IncidenceParameters
from gpusense.world.scanner import Reading

_MOST_BINS = 1000
# A float32 pi / 2 is this much more than the float64 one, or less.
_ROUNDING = 1e-6


@dataclass(frozen=True, eq=False)
class IncidenceFit:
    """The beam model's parameters for each range of angles of incidence.

    Attributes:
        parameters: The parameters of the bins, ready for a model.
        pooled: The fit of all readings with a surface together, on which thin bins lean.
        fits: (B,) the fit of each bin. Their traces are of log-likelihood and log prior; their standard errors take the
            pseudo-readings for readings.
        counts: (B,) readings of each bin, hits and max readings.
        no_surface: The fit of beams that hit no surface, of the same kind; None where there was nothing to fit it to,
            neither readings nor pseudo-readings.
        no_surface_count: Their hits and max readings.
        strength: Pseudo-readings that each of these fits was given from the pooled fit.
    """

    parameters: IncidenceParameters
    pooled: BeamFit
    fits: tuple[BeamFit, ...]
    counts: tuple[int, ...]
    no_surface: BeamFit | None
    no_surface_count: int
    strength: float

    @property
    def converged(self) -> bool:
        """Whether every fit did."""
        return self.pooled.converged and all(fit.converged for fit in self._all_fits)

    @property
    def log_likelihood(self) -> float:
        """Of all readings, each with its own parameters: what a model with ``parameters`` gives to them."""
        return math.fsum(fit.log_likelihood for fit in self._all_fits)

    @property
    def _all_fits(self) -> tuple[BeamFit, ...]:
        return self.fits if self.no_surface is None else (*self.fits, self.no_surface)

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain numbers, lists and strings."""
        return {
            "parameters": self.parameters.to_dict(),
            "pooled": self.pooled.to_dict(),
            "fits": [fit.to_dict() for fit in self.fits],
            "counts": list(self.counts),
            "no_surface": None if self.no_surface is None else self.no_surface.to_dict(),
            "no_surface_count": self.no_surface_count,
            "strength": self.strength,
        }

    def __str__(self) -> str:
        names = list(self.pooled.parameters.to_dict())
        lines = [f"{'incidence [deg]':16}{'readings':>10}" + "".join(f"{name:>14}" for name in names)]
        edges = np.degrees(self.parameters.edges)
        bins = [f"{low:.0f} to {high:.0f}" for low, high in pairwise(edges)]
        rows = list(zip(["all", *bins], [sum(self.counts), *self.counts], [self.pooled, *self.fits], strict=True))
        if self.no_surface is not None:
            rows.append(("no surface", self.no_surface_count, self.no_surface))
        for name, count, fit in rows:
            numbers = "".join(f"{value:14.5g}" for value in fit.parameters.to_dict().values())
            lines.append(f"{name:16}{count:10}{numbers}{'' if fit.converged else '  ' + fit.status}")
        lines.append(
            f"'all' are those with a surface; a prior of {self.strength:g} pseudo-readings like them in each row"
        )
        return "\n".join(lines)


def fit_incidence_parameters(
    ranges: ArrayLike,
    expected: ArrayLike,
    incidence: ArrayLike,
    range_max: float,
    *,
    bins: int | Sequence[float] | NDArray[np.floating] = 6,
    strength: float = 30.0,
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
    sigma_bounds: tuple[float, float] | None = None,
    lambda_bounds: tuple[float, float] | None = None,
    progress: bool = False,
    callback: Callback | None = None,
) -> IncidenceFit:
    """Learn the beam model's parameters for each range of angles of incidence.

    All readings with a surface are fitted together first. Each bin is then given ``strength`` pseudo-readings that are
    distributed as this pooled fit says (a Dirichlet prior of the weights and its like for the shapes), and fitted from
    there: a bin of thousands of readings hardly notices, an empty one keeps the pooled parameters.

    A number of bins means bins of equal width. What changes with the angle, lost echoes and long tails, changes fastest
    near grazing incidence, where readings are few; bins of equal count would put that into one.

    Beams that hit no surface have parameters of their own, fitted in the same way: "no return" is what is expected of
    them, and counting it for a bin of angles would teach that walls are often missed.

    Args:
        ranges: Readings z of any shape [m].
        expected: Expected ranges z* of the same shape, in [0, range_max] [m].
        incidence: Angles of incidence of the same shape, in [0, pi / 2] [rad]; NaN where the beam hits no surface.
        range_max: Readings of at least this are "no return" [m].
        bins: Number of bins of equal width, or (B + 1,) their edges, rising from 0 to pi / 2 [rad].
        strength: Pseudo-readings of each bin, >= 0; 0 fits every bin by itself. Without them, and without a reading of
            a beam that hits no surface, such beams keep the first bin's parameters.
        method: See :func:`fit_beam_parameters`, as for all that follows; not ``"em-book"``, which knows no prior.
        range_min: Readings below this are missing [m].
        initial: Where the pooled fit begins.
        backend: Where it runs.
        precision: ``"float64"`` or ``"float32"``; None is float64 where the device has it.
        max_iterations: Most iterations of each fit.
        tolerance: Nats left to gain.
        restarts: Further starts at random, of each fit.
        seed: Their seed.
        range_bias: Also fit an offset of correct ranges in each bin.
        sigma_bounds: Smallest and largest sigma_hit [m].
        lambda_bounds: Smallest and largest lambda_short [1/m].
        progress: Draw a progress bar for each fit on standard error where that is a terminal.
        callback: Called after each iteration.

    Returns:
        The fit; ``fit.parameters`` goes into a model.

    Raises:
        TypeError: an argument is not of the kind described.
        ValueError: a value breaks a rule above or of :func:`fit_beam_parameters`, or no reading has a surface.
    """
    pairs = make_pairs(ranges, expected, range_max, range_min)
    angles = _angles(incidence, np.shape(ranges), pairs)
    edges = _edges(bins)
    strength = checks.real("strength", strength, low=0)
    if method == "em-book":
        raise ValueError("method: must not be 'em-book', which knows no prior, got 'em-book'")
    options = check_options(
        method, max_iterations, tolerance, restarts, seed, range_bias, progress, callback, responsibilities=False
    )
    used = pairs.kinds != Reading.MISSING
    surface = ~np.isnan(angles)
    if not (used & surface).any():
        raise ValueError("incidence: some reading that is not missing must have an angle, got NaN beside all")
    if initial is not None and not isinstance(initial, BeamParameters):
        raise TypeError(f"initial: must be BeamParameters, got {checks.show(initial)}")
    opened = open_device(backend, precision)

    whole = pairs.subset(surface)
    bounds = make_bounds(whole, sigma_bounds, lambda_bounds)
    start = first_guess(whole, bounds) if initial is None else start_of(initial, whole, bounds)
    pooled = fit_pairs(DeviceSums(*opened, whole), whole, bounds, start, options)
    middle = Point.of(pooled.parameters, pooled.range_bias if range_bias else 0.0)
    prior = Prior(strength * middle.weights, middle.sigma, middle.rate, middle.bias)

    place = np.digitize(angles, edges[1:-1])
    fits, counts = [], []
    for number in range(len(edges) - 1):
        own = pairs.subset(surface & (place == number))
        counts.append(own.hits + own.max_readings)
        if not counts[-1] and strength == 0:
            low, high = np.degrees(edges[number : number + 2])
            raise ValueError(
                f"strength: must be > 0 where a bin has no reading, got {strength} and none from {low:.3g} to "
                f"{high:.3g} degrees"
            )
        fits.append(fit_pairs(DeviceSums(*opened, own), own, bounds, middle, options, prior))
    own = pairs.subset(~surface)
    nothing, count = None, own.hits + own.max_readings
    if count or strength > 0:
        # Such beams may need a cause that surfaces do without.
        weights = 0.5 * (middle.weights + first_guess(own, bounds).weights) if count else middle.weights
        start = replace(middle, weights=weights)
        nothing = fit_pairs(DeviceSums(*opened, own), own, bounds, start, options, prior)
    parameters = IncidenceParameters(
        tuple(edges.tolist()), tuple(fit.parameters for fit in fits), None if nothing is None else nothing.parameters
    )
    return IncidenceFit(parameters, pooled, tuple(fits), tuple(counts), nothing, count, strength)


def _angles(incidence: ArrayLike, shape: tuple[int, ...], pairs: Pairs) -> NDArray[np.float64]:
    """(n,) angles in [0, pi / 2], NaN without a surface."""
    given = checks.array("incidence", incidence, finite=False)
    if given.shape != shape:
        raise ValueError(
            f"incidence: shape must be that of ranges, {checks.shape_text(shape)}, got {checks.shape_text(given.shape)}"
        )
    angles = given.ravel()
    outside = (pairs.kinds != Reading.MISSING) & ((angles < 0) | (angles > math.pi / 2 + _ROUNDING))
    if outside.any():
        index = int(np.argmax(outside))
        raise ValueError(f"incidence: every angle must be in [0, pi / 2] or NaN, got {angles[index]} at index {index}")
    return np.minimum(angles, math.pi / 2)


def _edges(bins: int | Sequence[float] | NDArray[np.floating]) -> NDArray[np.float64]:
    """(B + 1,) edges from 0 to pi / 2."""
    if isinstance(bins, (int, np.integer)) and not isinstance(bins, bool):
        return np.linspace(0, math.pi / 2, checks.integer("bins", bins, low=1, high=_MOST_BINS) + 1)
    edges: NDArray[np.float64] = checks.array("bins", bins, ("B + 1",))
    if len(edges) < 2 or edges[0] != 0 or abs(edges[-1] - math.pi / 2) > _ROUNDING or (np.diff(edges) <= 0).any():
        raise ValueError(f"bins: edges must rise from 0 to pi / 2, got {checks.show(bins)}")
    return np.append(edges[:-1], math.pi / 2)
