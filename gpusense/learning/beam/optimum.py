"""Search for the highest maximum: try several starts, and causes that a search dropped too early.

A cause of weight 0 gets the weight of a hundredth of a reading, with each shape of a coarse list. If it then accounts
for more than this, the likelihood rises with its weight (Lindsay 1983), and the search continues with this cause. See
docs/background/learning.md, "Several maxima".
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from gpusense._util.typing import Floats
from gpusense.learning.beam.em import Climb, Watch
from gpusense.learning.beam.pairs import HIT, MAX, RAND, SHORT, Bounds, Pairs, Point, possible_causes
from gpusense.learning.beam.problem import NOTHING, Problem, Value
from gpusense.learning.point.densities import half_sample_mode
from gpusense.world.hit_shapes import NORMAL
from gpusense.world.range_causes import RandomDensity, ShortDensity

# Gain [nats] below which two ends count as the same maximum.
_SAME = 1e-3
# Largest number of continued searches.
_MOST = 4
# Number of shapes to try per cause, and weights to try.
_SHAPES, _WEIGHTS = 9, (1e-4, 1e-3, 1e-2, 0.1, 0.3)

Method = Callable[[Problem, Point, Watch], Climb]
# Shares of correct readings that starts assume.
_SHARES = (1.0, 0.5, 0.2, 0.05)


@dataclass
class Search:
    """Search for the highest maximum by one method."""

    problem: Problem
    method: Method  # the search from one start
    watch: Watch  # function called after each iteration

    def run(self, start: Point, more: list[Point], *, chosen: bool = False, known: Point | None = None) -> Climb:
        """Search from a start ``chosen`` by the user, or else from the likeliest one and those that exceed the result.

        Other starts have the causes of ``start`` and come from the readings; ``known`` may lack some causes. Each of
        ``more`` is followed to its maximum. Notes report lower ends, and a likelier start than the chosen one.
        """
        problem, causes = self.problem, start.weights > 0
        points = choose_starts(problem.pairs, problem.bounds, causes, problem.fit_bias)
        others = [problem.value(replace(point, shape=start.shape)) for point in points]
        others = [value for value in others if math.isfinite(value.objective)]
        values = [problem.value(point) for point in (start, known) if point is not None]
        if not chosen:
            values = sorted(values + others, key=lambda value: -value.objective)
        climb = self._climb(values[0].point, causes)
        for value in values[1:]:
            if value.objective > climb.value.objective + _SAME:
                climb = max(climb, self._climb(value.point, causes), key=_objective)
        ends = [climb, *(self._climb(point, causes) for point in more)]
        best = max(ends, key=_objective)
        lower = [best.value.objective - end.value.objective for end in ends]
        lower = [each for each in lower if each > _SAME]
        if lower:
            best.notes.append(f"{len(lower)} of {len(ends)} starts ended lower, by up to {max(lower):.3g} nats")
        higher = max((value.objective for value in others), default=-math.inf) - best.value.objective
        if chosen and higher > _SAME:
            best.notes.append(f"another start is at least {higher:.3g} nats higher: leave out 'initial'")
        return best

    def _climb(self, start: Point, causes: NDArray[np.bool_]) -> Climb:
        """Search from a start, and continue with causes that the search dropped too early."""
        causes = causes & possible_causes(self.problem.pairs)
        climb = self.method(self.problem, start, self.watch)
        for _ in range(_MOST):
            point = self._revived(climb.value, causes) if climb.converged else None
            if point is None:
                return climb
            done = len(climb.trace) - 1
            watch = partial(lambda done, iteration, value: self.watch(done + iteration, value), done)
            following = self.method(self.problem, point, watch)
            if following.value.objective <= climb.value.objective + _SAME:
                return climb
            climb = replace(following, trace=climb.trace + following.trace[1:])
        return climb

    def _revived(self, value: Value, causes: NDArray[np.bool_]) -> Point | None:
        """Return a likelier point where a cause of weight 0 gets some weight, or None."""
        best = value
        for cause in np.flatnonzero(causes & (value.point.weights == 0)):
            bounds = {HIT: self.problem.bounds.sigma, SHORT: self.problem.bounds.rate}.get(int(cause))
            shapes = [None] if bounds is None else np.geomspace(*bounds, _SHAPES).tolist()
            tried = [self._with(value.point, int(cause), shape, NOTHING / self.problem.total) for shape in shapes]
            values = [self.problem.value(point) for point in tried]
            likeliest = max(values, key=lambda each: each.totals[cause])
            if likeliest.totals[cause] <= NOTHING * (1 + 1e-6):
                continue
            for weight in _WEIGHTS:
                candidate = self.problem.value(self._with(likeliest.point, int(cause), None, weight))
                best = max(best, candidate, key=lambda each: each.objective)
        return best.point if best.objective > value.objective + _SAME else None

    def _with(self, point: Point, cause: int, shape: float | None, weight: float) -> Point:
        """Return the point with another weight of a cause, and another shape."""
        others = np.where(np.arange(4) == cause, 0.0, point.weights)
        weights: Floats = others * (1 - weight) / others.sum()
        weights[cause] = weight
        if shape is not None:
            point = replace(point, sigma=shape) if cause == HIT else replace(point, rate=shape)
        return replace(point, weights=weights)


def _objective(climb: Climb) -> float:
    return climb.value.objective


# Readings in the sample, steps of each short run, and largest number of returned starts.
_SAMPLE, _STEPS, _MOST = 1000, 20, 4
# Points differ if a weight differs by more than this, or a shape by more than this factor.
_WEIGHT, _FACTOR = 0.1, 1.5


@dataclass(frozen=True)
class Sample:
    """Sample of hits for choosing starts."""

    reading: Floats  # (m,) readings [m]
    expected: Floats  # (m,) expected ranges [m]
    share: float  # share of max readings among all readings
    range_max: float  # longest range [m]

    @classmethod
    def of(cls, pairs: Pairs) -> Sample:
        """Draw hits at random with a fixed seed, so that a regular order of beams has no effect."""
        chosen = np.arange(pairs.hits)
        if pairs.hits > _SAMPLE:
            chosen = np.random.default_rng(0).choice(pairs.hits, _SAMPLE, replace=False)
        z, expected = (values[chosen].astype(np.float64) for values in (pairs.reading, pairs.expected))
        return cls(z, expected, pairs.max_readings / pairs.readings, pairs.range_max)


def choose_starts(pairs: Pairs, bounds: Bounds, causes: NDArray[np.bool_], fit_bias: bool) -> list[Point]:
    """Return up to four different starts, the likeliest on a sample of the readings first."""
    if not pairs.hits or not causes[[HIT, SHORT, RAND]].any():
        return []
    sample = Sample.of(pairs)
    off = sample.reading - sample.expected
    biases = [0.0, float(np.median(off)), half_sample_mode(off)] if fit_bias else [0.0]
    starts = [
        point
        for bias, share in itertools.product(biases, _SHARES)
        for point in _assume(sample, bounds, causes, bias, share)
    ]
    ends, log_p = short_runs(sample, starts, bounds, fit_bias)
    chosen: list[Point] = []
    for i in np.argsort(-log_p, kind="stable"):
        if math.isfinite(log_p[i]) and all(_different(ends[i], other) for other in chosen):
            chosen.append(ends[i])
    return chosen[:_MOST]


def _assume(sample: Sample, bounds: Bounds, causes: NDArray[np.bool_], bias: float, share: float) -> list[Point]:
    """Return starts for a share of correct readings, one per lambda_short."""
    z, top = sample.reading, sample.range_max
    off = np.abs(z - sample.expected - bias)
    sigma = 1.4826 * float(np.quantile(off, 0.5 * share))
    before = z[(z < sample.expected - 3 * sigma) & (off > 3 * sigma)]
    length = float(before.mean()) if len(before) else 0.5 * top
    early = len(before) / len(z)
    weights = np.array([share, 0.5 * (1 - share) * early + 0.02, 0.0, (1 - share) * (1 - 0.5 * early) + 0.02])
    weights = np.where(causes, np.append(weights[:2], [0.0, weights[RAND]]) + 1e-3, 0.0)
    weights[MAX] = 0.0
    weights *= (1 - sample.share * causes[MAX]) / weights.sum()
    weights[MAX] = sample.share * causes[MAX]
    rates = [0.1 / top, *(factor / max(length, 1e-3 * top) for factor in (1, 5, 25))]
    return [bounds.hold(Point(weights, sigma, rate, bias)) for rate in rates]


def short_runs(
    sample: Sample, starts: list[Point], bounds: Bounds, fit_bias: bool
) -> tuple[list[Point], NDArray[np.float64]]:
    """Run a few steps of EM without truncation from C starts on a sample; return ends and (C,) log-likelihoods."""
    z, expected = sample.reading[:, None], sample.expected[:, None]
    weights = np.array([point.weights for point in starts])
    sigma, rate, bias = (np.array([getattr(point, name) for point in starts]) for name in ("sigma", "rate", "bias"))
    off = z - expected
    used = weights > 0
    for step in range(_STEPS + 1):
        log_p = _log_components(sample, z, expected, sigma, rate, bias)
        with np.errstate(divide="ignore", invalid="ignore"):
            log_p += np.log(weights.T[[HIT, SHORT, RAND], None, :])
            total = np.logaddexp.reduce(log_p, axis=0)
            parts = np.where(np.isneginf(log_p), 0.0, np.exp(log_p - total))
        if step == _STEPS:
            break
        sums = parts.sum(axis=1)
        weights[:, [HIT, SHORT, RAND]] = (1 - weights[:, MAX, None]) * sums.T / len(sample.reading)
        hits = np.maximum(sums[0], 1e-9)
        if fit_bias:
            bias = np.clip((parts[0] * off).sum(axis=0) / hits, -bounds.bias, bounds.bias)
        sigma = np.clip(np.sqrt((parts[0] * (off - bias) ** 2).sum(axis=0) / hits), *bounds.sigma)
        rate = _next_rate(parts[1], z, expected, rate, bounds)
    count = len(sample.reading)
    weights = np.where(used, weights * count + 0.5, 0.0)
    weights /= weights.sum(axis=1, keepdims=True)
    ends = [Point(w, float(s), float(r), float(b)) for w, s, r, b in zip(weights, sigma, rate, bias, strict=True)]
    return ends, total.sum(axis=0)


def _next_rate(parts: Floats, z: Floats, expected: Floats, rate: Floats, bounds: Bounds) -> Floats:
    """Return (C,) lambda_short that fit the mean length of short readings of (m, C) responsibilities ``parts``."""
    lengths = (parts * z).sum(axis=0)
    likely = (parts * ShortDensity(rate).mean(expected)).sum(axis=0)
    known = (lengths > 0) & (likely > 0)
    with np.errstate(over="ignore"):
        return np.where(known, np.clip(likely / np.where(known, lengths, 1.0), *bounds.rate), rate)


def _log_components(sample: Sample, z: Floats, expected: Floats, sigma: Floats, rate: Floats, bias: Floats) -> Floats:
    """Return (3, m, C) log densities of hit, short and rand; -inf where a cause is impossible."""
    mean = np.clip(expected + bias, 0, sample.range_max)
    mass = NORMAL.half_mass(mean / sigma) + NORMAL.half_mass((sample.range_max - mean) / sigma)
    hit = NORMAL.log_pdf((z - mean) / sigma) - np.log(sigma * np.maximum(mass, 1e-300))
    rand = np.full_like(hit, RandomDensity(sample.range_max).log_peak(1.0))
    return np.stack([hit, ShortDensity(rate).log_pdf(z, expected), rand])


def _different(one: Point, other: Point) -> bool:
    ratios = math.log(one.sigma / other.sigma), math.log(one.rate / other.rate)
    shapes = max(map(abs, ratios)) > math.log(_FACTOR)
    moved = abs(one.bias - other.bias) > min(one.sigma, other.sigma)
    return shapes or moved or bool((np.abs(one.weights - other.weights) > _WEIGHT).any())
