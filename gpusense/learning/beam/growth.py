"""Fit the shape of hits, and the growth of their deviation with range, jointly with all other parameters.

The shape alone is fitted on the device: EM takes the M-steps of a normal with weighted readings, and the degrees of
freedom move by Newton steps, as in ECME (Liu and Rubin 1994). Growth gives each reading a deviation, so its search
computes log p and gradient of every pair on the host, in Newton steps within bounds. No step lowers the likelihood.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from gpusense._util.typing import Floats
from gpusense.learning.beam.device_sums import DeviceSums, Options
from gpusense.learning.beam.em import climb_em
from gpusense.learning.beam.pairs import Bounds, Pairs, Point
from gpusense.learning.beam.problem import NO_PRIOR, Problem, Value
from gpusense.learning.beam.report import report
from gpusense.learning.fitted import BeamFit, Fitted, PointFit
from gpusense.learning.point import problem as hosted
from gpusense.learning.point.densities import by_shape, truncated
from gpusense.learning.point.problem import mix, of_weight
from gpusense.world.hit_shapes import SHAPES, HitName, HitShape, shape_of
from gpusense.world.hit_tables import TabulatedHit
from gpusense.world.parameters import BeamParameters
from gpusense.world.range_causes import NoReturn, RandomDensity, ShortDensity
from gpusense.world.scanner import Reading

# Number of readings for ranking the starts, and the remaining gain [nats] that suffices for the ranking.
_SAMPLE, _ROUGHLY = 20_000, 1e-2


def fit_shape(
    fit: BeamFit,
    device: DeviceSums,
    pairs: Pairs,
    bounds: Bounds,
    options: Options,
    hit: HitName,
    first: Point,
    initial: BeamParameters | None,
) -> BeamFit:
    """Fit the shape of hits as well, from a fit with normal hits."""
    kind = SHAPES[hit]
    if not pairs.hits or not pairs.expected.any():
        return _without_ranges(fit, hit, kind.fitted)
    normal = Point.of(fit.parameters)
    starts = [
        bounds.hold(replace(normal, sigma=factor * normal.sigma, shape=kind.at(np.array(shape))))
        for *shape, factor in kind.starts
    ]
    if initial is not None and initial.hit == hit:
        starts.append(replace(first, shape=shape_of(initial)))
    problem = Problem(device, pairs, bounds, NO_PRIOR, options.range_bias)
    sample = _sampled(problem)
    # A small gain suffices to rank the starts.
    most, roughly = options.max_iterations, max(options.tolerance, _ROUGHLY)
    ends = [climb_em(sample, start, max_iterations=most, tolerance=roughly, watch=lambda *_: None) for start in starts]
    best = max(ends, key=lambda end: end.value.objective)
    start, known = best.value.point, best.trace[:-1] if sample is problem else []

    def watch(iteration: int, value: Value) -> None:
        if options.callback is not None:
            options.callback(fit.iterations + len(known) + iteration, value.log_likelihood, value.point.parameters())

    end = climb_em(problem, start, max_iterations=most, tolerance=options.tolerance, watch=watch)
    return report(problem, replace(end, trace=known + end.trace), options, start)


def _without_ranges(fit: BeamFit, hit: HitName, new: tuple[str, ...]) -> BeamFit:
    """Return the fit of readings without a range, which do not determine the parameters ``new``."""
    reason = "no range determines it"
    return replace(
        fit, parameters=fit.parameters.replace(hit=hit), status=f"{fit.status}; {', '.join(new)}: {reason}",
        held=fit.held | dict.fromkeys(new, reason),
    )  # fmt: skip


def _sampled(problem: Problem) -> Problem:
    """Return the problem of a sample of the readings if there are many."""
    pairs = problem.pairs
    every = len(pairs.kinds) // _SAMPLE
    if every < 2:
        return problem
    some = pairs.subset(np.arange(len(pairs.kinds)) % every == 0)
    return Problem(problem.device.of(some), some, problem.bounds, problem.prior, problem.fit_bias)


# Shares of the deviation at the mean expected range that starts turn into growth; iterations of a search.
_SHARES, _ITERATIONS = (0.02, 0.3, 0.7, 0.95), 200
# Number of readings above which a table of masses is faster than the formula.
_MANY = 2000
_TOP, _RAND, _SHORT, _SIGMA, _GROWTH, _RATE, _BIAS = range(7)


@dataclass(frozen=True, eq=False)
class _Growing(hosted.Problem):
    """Likelihood by (z_max, share of rand, share of short in the rest, log sigma, growth, log rate[, bias][, shape]).

    The first three split the weights: z_rand is the share of rand times 1 - z_max, and so on. The coordinates of the
    shape come last.
    """

    per_reading: ClassVar[tuple[str, ...]] = ("reading", "expected", "none")
    reading: Floats
    expected: Floats
    none: NDArray[np.bool_]
    range_max: float
    within: Bounds
    start: BeamParameters
    fit_bias: bool
    reach: float
    kind: type[HitShape]

    def bounds(self) -> list[tuple[float, float]]:
        sigma, rate = (tuple(np.log(pair).tolist()) for pair in (self.within.sigma, self.within.rate))
        bias = [(-self.within.bias, self.within.bias)] * self.fit_bias
        return [*[(0.0, 1.0)] * 3, sigma, (0.0, 1.0), rate, *bias, *self.kind.limits]

    def scales(self, theta: Floats) -> Floats:
        sigma = math.exp(theta[_SIGMA]) + theta[_GROWTH] * self.reach
        shares = [of_weight(each) for each in theta[:_SIGMA]]
        shape = [
            max(0.3 * low, min(at, 0.3)) for at, (low, _) in zip(self._shape_at(theta), self.kind.limits, strict=True)
        ]
        return np.array([*shares, 1.0, sigma / self.reach, 1.0, *([sigma] if self.fit_bias else []), *shape])

    def starts(self) -> list[Floats]:
        p = self.start
        rest = max(1 - p.z_max, 1e-300)
        rand = min(max(p.z_rand / rest, 1e-3), 0.999)
        short = min(max(p.z_short / max(p.z_hit + p.z_short, 1e-300), 1e-3), 0.999)
        bias = [p.range_bias] if self.fit_bias else []
        rate = math.log(max(p.lambda_short, self.within.rate[0]))
        return [
            np.array([
                p.z_max, rand, short, math.log((1 - f) * factor * p.sigma_hit), f * factor * p.sigma_hit / self.reach,
                rate, *bias, *shape,
            ])
            for *shape, factor in self.kind.starts
            for f in _SHARES
        ]  # fmt: skip

    def _shape_at(self, theta: Floats) -> Floats:
        return theta[_BIAS + self.fit_bias :]

    def parts(self, theta: Floats) -> tuple[list[tuple[float, Floats]], list[Floats], Floats]:
        """Return weights and densities of hit, short and rand, and the derivatives of both by their coordinates."""
        z, expected, least = self.reading, self.expected, math.exp(theta[_SIGMA])
        sigma = least + theta[_GROWTH] * expected
        moved = expected + (theta[_BIAS] if self.fit_bias else 0.0)
        mean, at = np.clip(moved, 0, self.range_max), self._shape_at(theta)
        log_hit, by_sigma, by_mean = truncated(z - mean, mean, self.range_max, sigma, self._shape_of(at))
        ends = (z - mean) / sigma, mean / sigma, (self.range_max - mean) / sigma
        by_hit = [by_sigma * least / sigma, by_sigma * expected / sigma]
        by_hit += [by_mean * (mean == moved)] if self.fit_bias else []
        by_hit += by_shape(*ends, at, self._shape_of, self.kind.limits)
        obstacle, rand, short = ShortDensity(math.exp(theta[_RATE])), theta[_RAND], theta[_SHORT]
        weights = (1 - rand) * (1 - short), (1 - rand) * short, rand
        log_rand = np.full(len(z), RandomDensity(self.range_max).log_peak(1.0))
        densities = log_hit, obstacle.log_pdf(z, expected), log_rand
        return list(zip(weights, densities, strict=True)), by_hit, obstacle.by_log_rate(z, expected)

    def log_p(self, theta: Floats) -> tuple[Floats, Floats]:
        parts, by_hit, by_rate = self.parts(theta)
        log_p, (of_hit, of_short, _), (hit, short, rand) = mix(parts)
        top, share = theta[_TOP], theta[_SHORT]
        by_sigma, by_growth, *others = (of_hit * each for each in by_hit)
        columns = [
            np.full(len(log_p), -1 / max(1 - top, 1e-300)),
            rand - (1 - share) * hit - share * short,
            (1 - theta[_RAND]) * (short - hit),
            *(by_sigma, by_growth, of_short * by_rate, *others),
        ]
        gradient = np.where(self.none[:, None], 0.0, np.stack(columns, axis=1))
        gradient[self.none, _TOP] = 1 / max(top, 1e-300)
        with np.errstate(divide="ignore"):
            return np.where(self.none, NoReturn(top).log_mass, log_p + np.log1p(-top)), gradient

    def _shape_of(self, coordinates: Floats) -> HitShape:
        """Return the shape at coordinates; many readings look up masses in a table."""
        shape = self.kind.at(coordinates)
        return TabulatedHit.of_shape(shape) if shape.tabulated and len(self.reading) > _MANY else shape

    def values(self, theta: Floats) -> dict[str, float]:
        rest, rand, short = 1 - float(theta[_TOP]), float(theta[_RAND]), float(theta[_SHORT])
        values = {
            "z_hit": rest * (1 - rand) * (1 - short), "z_short": rest * (1 - rand) * short, "z_max": float(theta[_TOP]),
            "z_rand": rest * rand, "sigma_hit": math.exp(theta[_SIGMA]), "lambda_short": math.exp(theta[_RATE]),
            "sigma_growth": float(theta[_GROWTH]),
        }  # fmt: skip
        values |= {"range_bias": float(theta[_BIAS])} if self.fit_bias else {}
        return values | self.kind.at(self._shape_at(theta)).values()

    def parameters(self, theta: Floats, hit: HitName) -> BeamParameters:
        """Return the parameters of the model."""
        return BeamParameters(**self.values(theta), hit=hit)


def fit_jointly(
    fit: BeamFit,
    pairs: Pairs,
    bounds: Bounds,
    tolerance: float,
    responsibilities: bool,
    hit: HitName,
) -> BeamFit:
    """Fit the growth of the deviation, and the shape of hits, from a normal fit without growth."""
    new = ("sigma_growth", *SHAPES[hit].fitted)
    if not pairs.hits or not pairs.expected.any():
        return _without_ranges(fit, hit, new)
    known = pairs.kinds != Reading.MISSING
    reading, expected = np.zeros(len(known)), np.full(len(known), 0.5 * pairs.range_max)
    reading[pairs.places], expected[pairs.places] = pairs.reading, pairs.expected
    none = pairs.kinds[known] == Reading.MAX
    reach = float(np.mean(pairs.expected, dtype=np.float64))
    problem = _Growing(
        reading[known], expected[known], none, pairs.range_max, bounds, fit.parameters, fit.bias_fitted, reach,
        SHAPES[hit],
    )  # fmt: skip
    end = hosted.maximize(problem, _ITERATIONS, tolerance)
    blocks = None if pairs.block is None else pairs.block[known]
    inner = hosted.report(problem, end, problem.parameters(end.theta, hit), blocks, fit.missing)
    names = (*fit.standard_errors, *new)
    offset = inner if fit.bias_fitted else _with_offset(problem, end, tolerance, blocks)
    bias, error, independent = (
        math.nan if offset is None else getattr(offset, name)["range_bias"]
        for name in ("values", "standard_errors", "independent_errors")
    )
    rows = _causes(problem, end, known)
    shared = {each.name: getattr(inner, each.name) for each in fields(Fitted)}
    return replace(
        fit, **shared | {"standard_errors": {name: inner.standard_errors[name] for name in names}},
        independent_errors=inner.independent_errors | {"range_bias": independent}, range_bias=bias,
        range_bias_error=error, outliers=int((np.argmax(rows[known][~none][:, [0, 1, 3]], axis=1) == 2).sum()),
        responsibilities=rows if responsibilities else None,
    )  # fmt: skip


def _with_offset(
    problem: _Growing, end: hosted.Climb, tolerance: float, blocks: NDArray[np.int64] | None
) -> PointFit[BeamParameters] | None:
    """Fit the offset as well; None if the search did not converge."""
    joint = replace(problem, fit_bias=True)
    best = hosted.climb(joint, np.insert(end.theta, _BIAS, 0.0), _ITERATIONS, tolerance)
    return hosted.report(joint, best, problem.start, blocks, 0) if best.converged else None


def _causes(problem: _Growing, end: hosted.Climb, known: NDArray[np.bool_]) -> Floats:
    """Return the (n, 4) responsibilities of all readings; NaN for missing ones."""
    hit, short, rand = mix(problem.parts(end.theta)[0])[1]
    rows = np.full((len(known), 4), np.nan)
    rows[known] = np.stack([hit, short, np.zeros_like(hit), rand], axis=1)
    rows[np.flatnonzero(known)[problem.none]] = [0, 0, 1, 0]
    return rows
