"""Fit the parameters of the beam model by incidence bin, with the pooled fit as a prior."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpusense._util import checks
from gpusense._util.html import card
from gpusense._util.typing import FitMethod, Precision
from gpusense.backends import Selection
from gpusense.learning.beam.device_sums import Callback, DeviceSums, check_options, make_bounds, open_device, start_of
from gpusense.learning.beam.fit import fit_pairs
from gpusense.learning.beam.growth import fit_shape
from gpusense.learning.beam.pairs import Pairs, Point, first_guess, make_pairs
from gpusense.learning.beam.problem import Prior
from gpusense.learning.fitted import BeamFit, plain_fields
from gpusense.world.hit_shapes import SHAPES, HitName
from gpusense.world.parameters import BeamParameters, IncidenceParameters
from gpusense.world.scanner import Reading

_MOST_BINS = 1000
# Bound on the rounding error of a float32 pi / 2.
_ROUNDING = 1e-6


@dataclass(frozen=True, eq=False)
class IncidenceFit:
    """Parameters of the beam model for each incidence bin, fitted by :func:`fit_incidence_parameters`.

    ``print(fit)`` shows a table of the bins.

    Attributes:
        parameters: Parameters of the bins, ready for a model.
        pooled: Pooled fit of all readings with a surface: the prior of the bins.
        fits: (B,) fit of each bin. Traces hold log-likelihood plus log prior; standard errors include
            pseudo-readings.
        counts: (B,) readings of each bin, hits and max readings.
        no_surface: Fit of the beams that hit no surface, with the same prior; None without readings and
            pseudo-readings.
        no_surface_count: Hits and max readings of the beams that hit no surface.
        strength: Number of pseudo-readings of each fit, distributed as in the pooled fit.

    Example:
        >>> import gpusense as gs
        >>> z, expected, angles = [3.9, 4.1, 4.0, 4.3], [4.0] * 4, [0.1, 0.2, 0.3, 1.2]
        >>> fit = gs.fit_incidence_parameters(z, expected, angles, range_max=8.0, bins=2, backend="numpy")
        >>> fit
        IncidenceFit(2 bins, 4 readings, no_surface_count=0, strength=30, converged=True)
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
        """Return whether every fit converged."""
        return self.pooled.converged and all(fit.converged for fit in self._all_fits)

    @property
    def log_likelihood(self) -> float:
        """Log-likelihood of all readings, each with the parameters of its bin, as in a model with ``parameters``."""
        return math.fsum(fit.log_likelihood for fit in self._all_fits)

    @property
    def _all_fits(self) -> tuple[BeamFit, ...]:
        return self.fits if self.no_surface is None else (*self.fits, self.no_surface)

    def to_dict(self) -> dict[str, Any]:
        """Return all attributes as plain numbers, lists and strings."""
        return plain_fields(self)

    def __repr__(self) -> str:
        return (
            f"IncidenceFit({len(self.fits)} bins, {sum(self.counts)} readings, "
            f"no_surface_count={self.no_surface_count}, strength={self.strength:g}, converged={self.converged})"
        )

    def _repr_html_(self) -> str:
        names = list(self.pooled.standard_errors)
        bins = self._rows()[1 : 1 + len(self.fits)]
        rows = [(name, count, *(getattr(fit.parameters, each) for each in names)) for name, count, fit in bins]
        return card("IncidenceFit", rows, head=("incidence [deg]", "readings", *names), detail=str(self))

    def _rows(self) -> list[tuple[str, int, BeamFit]]:
        bins = [f"{low:.0f} to {high:.0f}" for low, high in pairwise(np.degrees(self.parameters.edges))]
        rows = [("all", sum(self.counts), self.pooled), *zip(bins, self.counts, self.fits, strict=True)]
        return rows + ([] if self.no_surface is None else [("no surface", self.no_surface_count, self.no_surface)])

    def __str__(self) -> str:
        names = [*self.pooled.standard_errors, *(["range_bias"] if self.pooled.bias_fitted else [])]
        lines = [f"{'incidence [deg]':16}{'readings':>10}" + "".join(f"{name:>14}" for name in names)]
        for name, count, fit in self._rows():
            numbers = "".join(f"{getattr(fit.parameters, parameter):14.5g}" for parameter in names)
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
    hit: HitName = "normal",
    blocks: ArrayLike | None = None,
    sigma_bounds: tuple[float, float] | None = None,
    lambda_bounds: tuple[float, float] | None = None,
    progress: bool = False,
    callback: Callback | None = None,
) -> IncidenceFit:
    """Fit the parameters of the beam model for each incidence bin.

    A pooled fit of all readings with a surface comes first. Each bin is then fitted with ``strength`` pseudo-readings
    distributed as in the pooled fit: a Dirichlet prior of the weights, and its counterpart for the shapes. Their effect
    on a bin of thousands of readings is small; an empty bin keeps the pooled parameters.

    ``bins`` as a number makes bins of equal width. Bins of equal count would merge all angles near grazing incidence,
    where readings are few but lost echoes and long tails change fastest.

    Beams that hit no surface get separate parameters, fitted with the same prior. In a bin, their expected "no return"
    would look like walls that are often missed.

    Args:
        ranges: Readings z of any shape [m].
        expected: Expected ranges z* of the same shape, in [0, range_max] [m].
        incidence: Angles of incidence of the same shape, in [0, pi / 2] [rad]; NaN for a beam that hits no surface.
        range_max: Readings of at least ``range_max`` are "no return" [m].
        bins: Number of bins of equal width, or (B + 1,) edges, rising from 0 to pi / 2 [rad].
        strength: Pseudo-readings per bin, >= 0; 0 fits every bin independently. With 0, beams without a surface and
            without readings take the first bin's parameters.
        method: Method of :func:`fit_beam_parameters` except ``"em-book"``, which cannot use a prior. All following
            arguments are described there.
        range_min: Readings below ``range_min`` are missing [m].
        initial: Start of the pooled fit.
        backend: The device.
        precision: ``"float64"`` or ``"float32"``; None is float64 if the device has it.
        max_iterations: Largest number of iterations of each fit.
        tolerance: Expected gain below which a fit has converged [nats].
        restarts: Number of additional random starts, at most 10 000 of each fit.
        seed: Seed of the random starts.
        range_bias: Whether to also fit an offset of correct ranges in each bin.
        hit: Shape of correct ranges, the same in all bins.
        blocks: Integer label of each reading's block, for standard errors of correlated readings.
        sigma_bounds: Smallest and largest sigma_hit [m].
        lambda_bounds: Smallest and largest lambda_short [1/m].
        progress: Show a progress bar for each fit on standard error if that is a terminal.
        callback: Function called after each iteration.

    Returns:
        The fit; pass ``fit.parameters`` to a model.

    Raises:
        TypeError: An argument has the wrong type.
        ValueError: A value breaks a rule above or of :func:`fit_beam_parameters`, or no reading has a surface.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> rng = np.random.default_rng(0)
        >>> angles, expected = rng.uniform(0, 1.5, 2000), np.full(2000, 4.0)
        >>> ranges = expected + rng.normal(0, np.where(angles < 0.75, 0.05, 0.2))
        >>> fit = gs.fit_incidence_parameters(ranges, expected, angles, range_max=8.0, bins=2, backend="numpy")
        >>> [round(p.sigma_hit, 2) for p in fit.parameters.parameters]
        [0.06, 0.2]
    """
    pairs = make_pairs(ranges, expected, range_max, range_min, blocks)
    angles = _angles(incidence, np.shape(ranges), pairs)
    edges = _edges(bins)
    strength = checks.real("strength", strength, low=0)
    if isinstance(method, str) and method == "em-book":
        raise ValueError("method: must not be 'em-book', which has no prior, got 'em-book'")
    options = check_options(
        method=method, max_iterations=max_iterations, tolerance=tolerance, restarts=restarts, seed=seed,
        range_bias=range_bias, progress=progress, callback=callback,
    )  # fmt: skip
    checks.choice("hit", hit, tuple(SHAPES))
    surface = ~np.isnan(angles)
    if not ((pairs.kinds != Reading.MISSING) & surface).any():
        raise ValueError("incidence: some reading that is not missing must have an angle, got NaN beside all")
    checks.instance("initial", initial, BeamParameters, optional=True)
    device = open_device(backend, precision)
    surfaces = pairs.subset(surface)
    bounds = make_bounds(surfaces, sigma_bounds, lambda_bounds)
    start = first_guess(surfaces, bounds) if initial is None else start_of(initial, surfaces, bounds, hit)
    sums = DeviceSums(*device, surfaces)
    pooled = fit_pairs(sums, surfaces, bounds, start, options, chosen=initial is not None)
    if hit != "normal":
        pooled = fit_shape(pooled, sums, surfaces, bounds, options, hit, start, initial)
    start = Point.of(pooled.parameters)
    prior = Prior(strength * start.weights, start.sigma, start.rate, start.bias, start.shape)

    def fit_of(some: Pairs, start: Point) -> BeamFit:
        return fit_pairs(DeviceSums(*device, some), some, bounds, start, options, prior)

    parts = _parts(pairs, angles, edges, strength)
    fits = tuple(fit_of(part, start) for part in parts)
    others, no_surface = pairs.subset(~surface), None
    if others.readings:
        # These beams may have causes that beams with a surface lack.
        weights = 0.5 * (start.weights + first_guess(others, bounds).weights)
        no_surface = fit_of(others, replace(start, weights=weights))
    elif strength > 0:
        no_surface = fit_of(others, start)
    parameters = IncidenceParameters(
        tuple(edges.tolist()),
        tuple(fit.parameters for fit in fits),
        None if no_surface is None else no_surface.parameters,
    )
    counts = tuple(part.readings for part in parts)
    return IncidenceFit(parameters, pooled, fits, counts, no_surface, others.readings, strength)


def _parts(pairs: Pairs, angles: NDArray[np.float64], edges: NDArray[np.float64], strength: float) -> list[Pairs]:
    """Return the pairs of each bin between (B + 1,) edges of the (n,) angles [rad]."""
    incidence_bin = np.where(np.isnan(angles), -1, np.digitize(angles, edges[1:-1]))
    parts = [pairs.subset(incidence_bin == number) for number in range(len(edges) - 1)]
    for number, part in enumerate(parts):
        if not part.readings and strength == 0:
            low, high = np.degrees(edges[number : number + 2])
            raise ValueError(
                f"strength: must be > 0 where a bin has no reading, got {strength} and none from {low:.3g} "
                f"to {high:.3g} degrees"
            )
    return parts


def _angles(incidence: ArrayLike, shape: tuple[int, ...], pairs: Pairs) -> NDArray[np.float64]:
    """Return (n,) angles in [0, pi / 2], NaN without a surface."""
    values = checks.array("incidence", incidence, finite=False)
    if values.shape != shape:
        text = checks.shape_text(values.shape)
        raise ValueError(f"incidence: shape must be that of ranges, {checks.shape_text(shape)}, got {text}")
    angles = values.ravel()
    outside = (pairs.kinds != Reading.MISSING) & ((angles < 0) | (angles > math.pi / 2 + _ROUNDING))
    if outside.any():
        index = int(np.argmax(outside))
        raise ValueError(f"incidence: every angle must be in [0, pi / 2] or NaN, got {angles[index]} at index {index}")
    return np.minimum(angles, math.pi / 2)


def _edges(bins: int | Sequence[float] | NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the (B + 1,) edges of the bins, from 0 to pi / 2."""
    if isinstance(bins, (int, np.integer)) and not isinstance(bins, bool):
        return np.linspace(0, math.pi / 2, checks.integer("bins", bins, low=1, high=_MOST_BINS) + 1)
    edges: NDArray[np.float64] = checks.array("bins", bins, ("B + 1",))
    if len(edges) < 2 or edges[0] != 0 or abs(edges[-1] - math.pi / 2) > _ROUNDING or (np.diff(edges) <= 0).any():
        raise ValueError(f"bins: edges must rise from 0 to pi / 2, got {checks.show(bins)}")
    return np.append(edges[:-1], math.pi / 2)
