"""Classify readings and pair them with expected ranges; represent parameters during a search by coordinates."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpusense._util import checks
from gpusense._util.typing import Floats, Integers
from gpusense.learning.fitted import number_blocks
from gpusense.world.hit_shapes import NORMAL, HitShape, name_of, shape_of
from gpusense.world.parameters import BeamParameters
from gpusense.world.plausible import look_at_readings
from gpusense.world.scanner import Reading, reading_classes

# Largest number of readings for estimating a sensor's rounding step.
_SAMPLE = 20_000


@dataclass(frozen=True)
class Pairs:
    """Readings and their expected ranges."""

    reading: NDArray[np.floating]  # (M,) readings of the hits, in the caller's precision [m]
    expected: NDArray[np.floating]  # (M,) expected ranges of the hits, in [0, range_max] [m]
    places: NDArray[np.intp]  # (M,) indices of the hits among all readings
    kinds: NDArray[np.uint8]  # (n,) class of every reading
    range_max: float  # longest range [m]
    quantum: float  # rounding step of the readings; 0 without one [m]
    block: Integers | None = None  # (n,) number of the block of each reading, -1 if missing; or None

    @property
    def hits(self) -> int:
        """Number of readings that are ranges."""
        return len(self.reading)

    @property
    def max_readings(self) -> int:
        """Number of readings that are "no return"."""
        return int(np.count_nonzero(self.kinds == Reading.MAX))

    @property
    def readings(self) -> int:
        """Number of readings that are not missing."""
        return self.hits + self.max_readings

    @property
    def missing(self) -> int:
        """Number of readings that are missing."""
        return int(np.count_nonzero(self.kinds == Reading.MISSING))

    @property
    def blocks(self) -> int:
        """Number of blocks with a reading that is not missing; 0 without blocks."""
        return 0 if self.block is None else len(np.unique(self.block[self.kinds != Reading.MISSING]))

    def subset(self, mask: NDArray[np.bool_]) -> Pairs:
        """Return the pairs of the readings in ``mask`` (n,)."""
        hits = mask[self.places]
        places = np.cumsum(mask)[self.places[hits]] - 1
        block = None if self.block is None else self.block[mask]
        chosen = self.reading[hits], self.expected[hits], places, self.kinds[mask]
        return Pairs(*chosen, self.range_max, self.quantum, block)


def make_pairs(
    ranges: ArrayLike, expected: ArrayLike, range_max: float, range_min: float = 0.0, blocks: ArrayLike | None = None
) -> Pairs:
    """Classify the readings, select the hits, and number the blocks."""
    range_max = checks.real("range_max", range_max, low=checks.SMALLEST, high=checks.FARTHEST)
    range_min = checks.real("range_min", range_min, low=0, below=range_max)
    z = checks.array("ranges", ranges, finite=False, dtype=None)
    z_expected = checks.array("expected", expected, finite=False, dtype=None)
    if z.shape != z_expected.shape:
        raise ValueError(
            f"expected: shape must be that of ranges, {checks.shape_text(z.shape)}, got "
            f"{checks.shape_text(z_expected.shape)}"
        )
    shape, z, z_expected = z.shape, z.ravel(), z_expected.ravel()
    kinds = reading_classes(z, range_min, range_max)
    look_at_readings("ranges", z, range_max, range_min=range_min)
    if not (kinds != Reading.MISSING).any():
        raise ValueError(f"ranges: must hold a reading that is not missing, got {z.size} of which none is")
    outside = impossible_ranges(kinds, z_expected, range_max)
    if outside.any():
        index = int(np.argmax(outside))
        raise ValueError(
            f"expected: every value must be in [0, range_max] where the reading is not missing, got "
            f"{z_expected[index]} at index {index}"
        )
    places = np.flatnonzero(kinds == Reading.HIT)
    reading, known = z[places], kinds != Reading.MISSING
    block, numbers = np.full(len(z), -1), number_blocks(blocks, shape, known)
    block[known] = -1 if numbers is None else numbers
    return Pairs(
        reading, np.minimum(z_expected[places], range_max), places, kinds, range_max, range_resolution(reading),
        None if numbers is None else block,
    )  # fmt: skip


def range_resolution(reading: NDArray[np.floating]) -> float:
    """Estimate the rounding step of readings, 0 without one: their gaps are its multiples, but for a few ulp."""
    sample = reading[:: max(1, len(reading) // _SAMPLE)]
    distinct = np.unique(sample).astype(np.float64)
    if len(distinct) < 2 or len(distinct) == len(sample):
        return 0.0
    gaps = np.diff(distinct)
    noise = 8 * float(np.finfo(reading.dtype).eps) * float(distinct[-1])
    gaps = gaps[gaps > noise]
    if not len(gaps):
        return 0.0
    step = float(gaps.min())
    step = float(np.median(gaps[gaps < 1.5 * step]))
    steps = gaps / step
    return step if bool((np.abs(steps - np.round(steps)) < 0.05 + noise / step).all()) and math.isfinite(step) else 0.0


def impossible_ranges(kinds: NDArray[np.uint8], expected: NDArray[np.floating], range_max: float) -> NDArray[np.bool_]:
    """Return the (n,) mask of expected ranges outside [0, range_max], rounded to their type, with a reading."""
    limit = max(float(expected.dtype.type(range_max)), range_max)
    return (kinds != Reading.MISSING) & ~((expected >= 0) & (expected <= limit))


# FORM is the first coordinate of the shape of hits.
HIT, SHORT, MAX, RAND, SIGMA, RATE, BIAS, FORM = range(8)
NAMES = ("z_hit", "z_short", "z_max", "z_rand", "sigma_hit", "lambda_short", "range_bias")

# Largest number of readings for a first guess.
_GUESS_SAMPLE = 100_000


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
        every = max(1, pairs.hits // _GUESS_SAMPLE)
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
