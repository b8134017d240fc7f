"""A set of parameters on the way to the best one, and the coordinates in which it is moved.

Coordinates are (log z_hit, log z_short, log z_max, log z_rand, log sigma_hit, log lambda_short, range_bias). Weights
are renormalised after every step, so one of the four logarithms, the largest weight's, stays where it is: the other
weights are moved against it.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gpusense.learning.beam.pairs import Pairs
from gpusense.world.parameters import BeamParameters

Floats = NDArray[np.float64]

HIT, SHORT, MAX, RAND, SIGMA, RATE, BIAS = range(7)
NAMES = ("z_hit", "z_short", "z_max", "z_rand", "sigma_hit", "lambda_short", "range_bias")

# Readings that are looked at for a first guess.
_SAMPLE = 100_000


@dataclass(frozen=True)
class Point:
    """Parameters during a fit.

    Attributes:
        weights: (4,) z_hit, z_short, z_max, z_rand.
        sigma: sigma_hit [m].
        rate: lambda_short [1/m].
        bias: Offset of correct ranges [m].
    """

    weights: Floats
    sigma: float
    rate: float
    bias: float = 0.0

    @classmethod
    def of(cls, parameters: BeamParameters, bias: float = 0.0) -> Point:
        """The point of a set of parameters, its weights' sum made 1."""
        p = parameters
        weights = np.array([p.z_hit, p.z_short, p.z_max, p.z_rand])
        return cls(weights / weights.sum(), p.sigma_hit, p.lambda_short, bias)

    def parameters(self) -> BeamParameters:
        """The model's parameters here."""
        hit, short, top, rand = self.weights.tolist()
        return BeamParameters(hit, short, top, rand, self.sigma, self.rate)

    def coordinates(self) -> Floats:
        """(7,) see the module's docstring; -inf for a weight of 0."""
        with np.errstate(divide="ignore"):
            return np.array([*np.log(self.weights), math.log(self.sigma), np.log(self.rate), self.bias])

    def moved(self, step: Floats, bounds: Bounds) -> Point:
        """The point after a step in coordinates, within the bounds."""
        with np.errstate(divide="ignore"):
            logs = np.log(self.weights) + step[:4]
        weights = np.exp(logs - logs.max())
        return bounds.hold(
            Point(
                weights / weights.sum(),
                self.sigma * math.exp(min(step[SIGMA], 700)),
                self.rate * math.exp(min(step[RATE], 700)),
                self.bias + step[BIAS],
            )
        )


@dataclass(frozen=True)
class Bounds:
    """Where shapes may lie.

    Attributes:
        sigma: Smallest and largest sigma_hit [m].
        rate: Smallest and largest lambda_short [1/m].
        bias: Largest offset of correct ranges, either way [m].
    """

    sigma: tuple[float, float]
    rate: tuple[float, float]
    bias: float

    def hold(self, point: Point) -> Point:
        """The point, its shapes moved to the bounds they exceed."""
        return dataclasses.replace(
            point,
            sigma=min(max(point.sigma, self.sigma[0]), self.sigma[1]),
            rate=min(max(point.rate, self.rate[0]), self.rate[1]),
            bias=min(max(point.bias, -self.bias), self.bias),
        )


def possible_causes(pairs: Pairs) -> NDArray[np.bool_]:
    """(4,) which causes some reading can have."""
    short = bool(((pairs.reading <= pairs.expected) & (pairs.expected > 0)).any())
    return np.array([pairs.hits > 0, short, pairs.max_readings > 0, pairs.hits > 0])


def first_guess(pairs: Pairs, bounds: Bounds) -> Point:
    """Where a fit begins: weights by the classes of readings, sigma from the median distance to the expected range."""
    possible = possible_causes(pairs)
    share = pairs.max_readings / (pairs.hits + pairs.max_readings)
    weights = np.where(possible, [(1 - share) * 0.5, (1 - share) * 0.2, share, (1 - share) * 0.3], 0)
    sigma, rate = 0.05 * pairs.range_max, 2 / pairs.range_max
    if pairs.hits:
        every = max(1, pairs.hits // _SAMPLE)
        z, expected = pairs.reading[::every].astype(np.float64), pairs.expected[::every].astype(np.float64)
        sigma = 1.4826 * float(np.median(np.abs(z - expected)))
        before = z[z < expected - 3 * sigma]
        rate = 1 / max(float(before.mean()), 1e-3 * pairs.range_max) if len(before) else rate
    return bounds.hold(Point(weights / weights.sum(), sigma, rate))


def random_start(point: Point, bounds: Bounds, rng: np.random.Generator) -> Point:
    """Another start: weights at random among those that are not 0, shapes within a factor of e^2 or so."""
    weights = np.where(point.weights > 0, rng.dirichlet(np.ones(4)) + 0.01, 0)
    sigma, rate = point.sigma * math.exp(rng.normal(0, 1)), point.rate * math.exp(rng.normal(0, 1))
    return bounds.hold(Point(weights / weights.sum(), sigma, rate, point.bias))
