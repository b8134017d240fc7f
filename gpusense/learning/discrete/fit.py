"""Learn the causes of the discrete model by maximum likelihood, from counts of (step of z*, step of z)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from gpusense._util import checks
from gpusense._util.typing import Floats, Integers
from gpusense.learning.discrete.probabilities import (
    MOST_BINS,
    DiscreteCauses,
    bins_of,
    check_pairs,
    separate_causes,
)
from gpusense.learning.fitted import DiscreteFit
from gpusense.learning.information import number_blocks
from gpusense.learning.point.problem import Problem, maximize, report

NAMES = ("lambda_short", "lambda_rand", "p_detect", "sigma_hit")
# Steps of first and second central differences; they balance rounding and truncation errors.
_FIRST, _SECOND = 1e-5, 1e-2
# Most iterations of a search, and the gain that ends it [nats].
_ITERATIONS, _TOLERANCE = 300, 1e-10
# Number of beam steps of the coarse problem in front of a search with many.
_FEW = 100
# Number of readings per pass.
_BLOCK = 1 << 20


def learn_causes(
    ranges: object, expected: object, range_max: float, bins: int, blocks: object = None
) -> tuple[DiscreteCauses, DiscreteFit]:
    """Learn the most likely causes; see ``DiscreteBeamModel.learn``.

    Newton steps move the logarithms of rates and sigma_hit and the log odds of detection, within bounds beyond which
    the table does not change. They follow the best of several starts; the highest end is the result.
    """
    data = count_pairs(ranges, expected, range_max, bins)
    problem, labels = _Causes(data), None
    end = maximize(problem, _ITERATIONS, _TOLERANCE)
    causes = _causes(end.theta)
    if blocks is not None:
        labels, data_of_blocks = _counts_of_blocks(data, ranges, expected, float(range_max), blocks)
        problem = _Causes(data_of_blocks)
    fit = report(problem, end, causes, labels, data.missing)
    errors = {
        each: {name: error if math.isfinite(error) else math.nan for name, error in getattr(fit, each).items()}
        for each in ("standard_errors", "independent_errors")
    }
    hits, none = (int(data.counts[some].sum()) for some in (data.steps < data.bins, data.steps == data.bins))
    return causes, DiscreteFit(**vars(fit) | errors | {"readings": hits + none, "hits": hits, "max": none})


@dataclass(frozen=True, eq=False)
class _Causes(Problem):
    """Likelihood of counts by (log lambda_short, log lambda_rand, log odds of p_detect, log sigma_hit)."""

    flat: ClassVar[float] = 1e-4
    # A deviation of 30 of a logarithm says nothing.
    least: ClassVar[float] = 1e-3
    data: Counts

    @property
    def readings(self) -> int:
        return len(self.data.counts)

    def part(self, every: int) -> _Causes:
        return _Causes(self.data.coarser(_FEW)) if self.data.bins > 2 * _FEW else self

    def bounds(self) -> tuple[Floats, Floats]:
        """Return bounds beyond which a table changes by less than a part in a million."""
        reach, width = self.data.bins * self.data.width, self.data.width
        rates = math.log(1e-9 / reach), math.log(30 / width)
        low, high = np.array([rates, rates, (-25.0, 25.0), (math.log(1e-6 * width), math.log(10 * reach))]).T
        return low, high

    def scales(self, theta: Floats) -> Floats:
        return np.ones(len(NAMES))

    def log_p(self, theta: Floats) -> tuple[Floats, Floats]:
        ends = [[self.data.log_p(_causes(theta + sign * step)) for sign in (1, -1)] for step in _FIRST * np.eye(4)]
        return self.data.log_p(_causes(theta)), np.stack([(a - b) / (2 * _FIRST) for a, b in ends], axis=1)

    def hessian(self, theta: Floats, free: NDArray[np.bool_]) -> Floats:
        def value(*shifts: Floats) -> float:
            return self.data.log_likelihood(_causes(theta + np.sum(shifts, axis=0)))

        steps, middle = _SECOND * np.eye(len(theta))[free], value(np.zeros(len(theta)))
        second = np.zeros((len(steps), len(steps)))
        for a, one in enumerate(steps):
            second[a, a] = value(one) - 2 * middle + value(-one)
            for b, two in enumerate(steps[:a]):
                mixed = value(one, two) - value(one, -two) - value(-one, two) + value(-one, -two)
                second[a, b] = second[b, a] = mixed / 4
        return second / _SECOND**2

    def values(self, theta: Floats) -> dict[str, float]:
        causes = _causes(theta)
        return {name: getattr(causes, name) for name in NAMES}

    def starts(self) -> list[Floats]:
        """Make starts from the shares of readings before, at and behind the expected step.

        Each start takes readings within another number of steps as correct.
        """
        data, starts = self.data, []
        reach, total = data.bins * data.width, float(data.counts.sum())
        known, none = data.rows < data.bins, data.steps == data.bins
        for near in sorted({0, 1, 3, max(data.bins // 30, 1), max(data.bins // 8, 1)}):
            at = known & ~none & (np.abs(data.rows - data.steps) <= near)
            short, behind = (float(data.counts[where & ~at].sum()) / total for where in (data.steps < data.rows, ~none))
            expected = float(data.counts[known].sum())
            detected = float(data.counts[at].sum()) / expected if expected else 0.5
            guess = [
                math.log(max(short, 1e-3) / (0.5 * reach)), math.log(max(behind - short, 1e-3) / reach),
                math.log((detected + 0.01) / (1.01 - detected)), math.log(max(0.5 * near, 0.2) * data.width),
            ]  # fmt: skip
            starts.append(np.array(guess))
        return starts


def _causes(theta: Floats) -> DiscreteCauses:
    short, rand, odds, sigma = (float(value) for value in theta)
    return DiscreteCauses(math.exp(short), math.exp(rand), 1 / (1 + math.exp(-odds)), math.exp(sigma))


def _counts_of_blocks(
    data: Counts, ranges: object, expected: object, range_max: float, blocks: object
) -> tuple[Integers, Counts]:
    """Return the block (E,) and the counts of all cells that each block occupies."""
    z, z_exp = (
        checks.as_array(name, value, masked=True) for name, value in (("ranges", ranges), ("expected", expected))
    )
    readings, expected_ranges = check_pairs(z.ravel(), z_exp.ravel(), range_max)
    i, j = (bins_of(each, range_max, data.bins) for each in (readings, expected_ranges))
    known = i >= 0
    numbers = number_blocks(blocks, z.shape, known)
    assert numbers is not None
    both, times = np.unique(np.stack([numbers, j[known], i[known]]), axis=1, return_counts=True)
    return both[0], replace(data, rows=both[1], steps=both[2], counts=times.astype(np.float64))


@dataclass(frozen=True)
class Counts:
    """Counts of readings: ``counts[k]`` readings in step ``steps[k]`` with an obstacle expected in ``rows[k]``."""

    rows: NDArray[np.int64]  # (K,) steps of expected ranges
    steps: NDArray[np.int64]  # (K,) steps of readings
    counts: Floats  # (K,) numbers of readings
    missing: int  # number of missing readings
    bins: int  # number of steps along the beam
    width: float  # width of a step [m]

    def log_p(self, causes: DiscreteCauses) -> Floats:
        """Return the (K,) log-likelihoods of the readings of each count."""
        values = causes.to_dict()
        return self.counts * separate_causes(self.bins, self.width, **values, rows=self.rows, steps=self.steps)

    def log_likelihood(self, causes: DiscreteCauses) -> float:
        """Return the log-likelihood of all readings, from the probabilities of their steps."""
        return float(self.log_p(causes).sum())

    def coarser(self, bins: int) -> Counts:
        """Return approximate counts in fewer steps."""
        scale = bins / self.bins
        both = np.trunc(np.stack([self.rows, self.steps]) * scale).astype(np.int64)
        cells, inverse = np.unique(both, axis=1, return_inverse=True)
        counts = np.bincount(inverse.ravel(), self.counts).astype(np.float64)
        return Counts(cells[0], cells[1], counts, self.missing, bins, self.bins * self.width / bins)


def count_pairs(ranges: object, expected: object, range_max: float, bins: int) -> Counts:
    """Count readings; see ``DiscreteBeamModel.learn`` for arguments and errors."""
    range_max = checks.real("range_max", range_max, low=checks.SMALLEST, high=checks.FARTHEST)
    bins = checks.integer("bins", bins, low=1, high=MOST_BINS)
    z, z_exp = (
        checks.as_array(name, value, masked=True) for name, value in (("ranges", ranges), ("expected", expected))
    )
    if z.shape != z_exp.shape:
        shapes = checks.shape_text(z.shape), checks.shape_text(z_exp.shape)
        raise ValueError(f"expected: shape must be {shapes[0]}, got {shapes[1]}")
    z, z_exp = z.reshape(-1), z_exp.reshape(-1)
    table, missing = np.zeros((bins + 1) ** 2, np.int64), 0
    for first in range(0, max(len(z), 1), _BLOCK):
        block = slice(first, first + _BLOCK)
        readings, expected_ranges = check_pairs(z[block], z_exp[block], range_max)
        i, j = bins_of(readings, range_max, bins), bins_of(expected_ranges, range_max, bins)
        missing += int(np.count_nonzero(i < 0))
        # bincount returns bins up to the last occupied one.
        counts = np.bincount((j * (bins + 1) + i)[i >= 0])
        table[: len(counts)] += counts
    cells = np.flatnonzero(table)
    if cells.size == 0:
        raise ValueError(f"ranges: must have a reading that is not missing, got {missing} missing ones")
    return Counts(cells // (bins + 1), cells % (bins + 1), table[cells].astype(float), missing, bins, range_max / bins)
