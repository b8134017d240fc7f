"""Represent parameters during a search by coordinates.

Coordinates are (log z_hit, log z_short, log z_max, log z_rand, log sigma_hit, log lambda_short, range_bias). Weights
are renormalised after every step: the logarithm of the largest weight stays fixed, and the other weights move relative
to it. The coordinates of the shape of hits follow, if any.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpusense._util.typing import Floats
from gpusense.learning.beam.pairs import Pairs
from gpusense.world.hit_shapes import NORMAL, HitShape, name_of, shape_of
from gpusense.world.parameters import BeamParameters

# FORM is the first coordinate of the shape of hits.
HIT, SHORT, MAX, RAND, SIGMA, RATE, BIAS, FORM = range(8)
NAMES = ("z_hit", "z_short", "z_max", "z_rand", "sigma_hit", "lambda_short", "range_bias")

# Largest number of readings for a first guess.
_SAMPLE = 100_000


@dataclass(frozen=True)
class Point:
    """Parameters during a search."""

    weights: Floats  # (4,) z_hit, z_short, z_max, z_rand
    sigma: float  # sigma_hit [m]
    rate: float  # lambda_short [1/m]
    bias: float = 0.0  # offset of correct ranges [m]
    shape: HitShape = NORMAL  # shape of the density of correct ranges, of scale sigma

    @classmethod
    def of(cls, parameters: BeamParameters) -> Point:
        """Make the point of a set of parameters, with weights normalised to sum 1."""
        p = parameters
        weights = np.array([p.z_hit, p.z_short, p.z_max, p.z_rand])
        return cls(weights / weights.sum(), p.sigma_hit, p.lambda_short, p.range_bias, shape_of(p))

    def parameters(self) -> BeamParameters:
        """Return the parameters of the model."""
        hit, short, top, rand = self.weights.tolist()
        shape = dict[str, Any](hit=name_of(self.shape), **self.shape.values())
        return BeamParameters(hit, short, top, rand, self.sigma, self.rate, self.bias, **shape)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters, in the order of the coordinates."""
        return NAMES + self.shape.fitted

    def coordinates(self) -> Floats:
        """Return the first (7,) coordinates; -inf for a weight of 0."""
        with np.errstate(divide="ignore"):
            return np.array([*np.log(self.weights), math.log(self.sigma), np.log(self.rate), self.bias])

    def moved(self, step: Floats, bounds: Bounds) -> Point:
        """Return the point after a step in coordinates, clamped to the bounds."""
        with np.errstate(divide="ignore"):
            logs = np.log(self.weights) + step[:4]
        weights = np.exp(logs - logs.max())
        return bounds.hold(
            Point(
                weights / weights.sum(),
                self.sigma * math.exp(min(step[SIGMA], 700)),
                self.rate * math.exp(min(step[RATE], 700)),
                self.bias + step[BIAS],
                self.shape_moved(step[FORM:]),
            )
        )

    def shape_moved(self, step: Floats) -> HitShape:
        """Return the shape after a step in its coordinates, clamped to their limits."""
        if not len(step):
            return self.shape
        low, high = np.array(self.shape.limits).T
        return self.shape.at(np.clip(self.shape.coordinates + step, low, high))


@dataclass(frozen=True)
class Bounds:
    """Bounds of the shapes."""

    sigma: tuple[float, float]  # smallest and largest sigma_hit [m]
    rate: tuple[float, float]  # smallest and largest lambda_short [1/m]
    bias: float  # largest magnitude of the offset of correct ranges [m]

    def hold(self, point: Point) -> Point:
        """Return the point with its shapes clamped to the bounds."""
        return dataclasses.replace(
            point,
            sigma=min(max(point.sigma, self.sigma[0]), self.sigma[1]),
            rate=min(max(point.rate, self.rate[0]), self.rate[1]),
            bias=min(max(point.bias, -self.bias), self.bias),
        )


def possible_causes(pairs: Pairs) -> NDArray[np.bool_]:
    """Return the (4,) mask of causes that at least one reading can have."""
    short = bool(((pairs.reading <= pairs.expected) & (pairs.expected > 0)).any())
    return np.array([pairs.hits > 0, short, pairs.max_readings > 0, pairs.hits > 0])


def first_guess(pairs: Pairs, bounds: Bounds) -> Point:
    """Guess a start: weights from the classes of readings, sigma from the median distance to the expected range."""
    possible = possible_causes(pairs)
    share = pairs.max_readings / pairs.readings
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
    """Draw a random start: random weights for causes of weight > 0, shapes within a factor of about e^2."""
    weights = np.where(point.weights > 0, rng.dirichlet(np.ones(4)) + 0.01, 0)
    sigma, rate = point.sigma * math.exp(rng.normal(0, 1)), point.rate * math.exp(rng.normal(0, 1))
    return bounds.hold(Point(weights / weights.sum(), sigma, rate, point.bias))
