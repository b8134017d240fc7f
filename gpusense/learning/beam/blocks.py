"""Compute the scatter of the likelihood's gradient over blocks, for standard errors of correlated readings.

Errors within a scan and between neighbouring scans are correlated. The inverse of the observed information H then is
not the covariance of the parameters. For independent blocks with gradients G_b of the log-likelihood, the covariance is

    H^-1 (sum_b G_b G_b') H^-1,

even if the mixture is not the true distribution. The sum is centred and multiplied by B / (B - 1).

Source: White (1982), "Maximum likelihood estimation of misspecified models"; Liang and Zeger (1986), "Longitudinal data
analysis using generalized linear models".
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpusense._util import checks
from gpusense._util.typing import Floats
from gpusense.learning.beam.pairs import Pairs
from gpusense.learning.beam.point import BIAS, FORM, HIT, MAX, RAND, RATE, SHORT, SIGMA, Point
from gpusense.learning.beam.problem import Problem
from gpusense.learning.information import scatter_of
from gpusense.learning.point.densities import by_shape, truncated
from gpusense.world.range_causes import ShortDensity
from gpusense.world.scanner import Reading

# Number of readings per pass.
_PART = 1 << 18


def check_blocks(blocks: ArrayLike, shape: tuple[int, ...], pairs: Pairs) -> NDArray[np.intp]:
    """Return the (n,) blocks of all readings, numbered from 0 in the order of their labels."""
    labels = checks.as_array("blocks", blocks)
    if labels.dtype.kind not in "iu":
        raise TypeError(f"blocks: must hold integers, got {checks.show(blocks)}")
    if labels.shape != shape:
        text = checks.shape_text(labels.shape)
        raise ValueError(f"blocks: shape must be that of ranges, {checks.shape_text(shape)}, got {text}")
    numbers = np.unique(labels.ravel(), return_inverse=True)[1].ravel()
    count = len(np.unique(numbers[pairs.kinds != Reading.MISSING]))
    if count < 2:
        raise ValueError(f"blocks: must be at least 2 with a reading that is not missing, got {count}")
    return numbers


def count_blocks(pairs: Pairs) -> int:
    """Return the number of blocks with a reading that is not missing; 0 without blocks."""
    return 0 if pairs.block is None else len(np.unique(pairs.block[pairs.kinds != Reading.MISSING]))


def block_scatter(problem: Problem, point: Point) -> Floats:
    """Return the scatter of the log-likelihood's gradient over blocks; NaN for fewer than 2 blocks."""
    sums, counts = block_gradients(problem, point)
    return scatter_of(sums[counts > 0])


def block_gradients(problem: Problem, point: Point) -> tuple[Floats, NDArray[np.intp]]:
    """Return the gradients of the blocks' log-likelihoods, one per row, and the (B,) numbers of readings."""
    pairs = problem.pairs
    assert pairs.block is not None
    size = int(pairs.block.max(initial=-1)) + 1
    of_hits, of_max = pairs.block[pairs.places], pairs.block[pairs.kinds == Reading.MAX]
    counts = np.bincount(of_hits, minlength=size) + np.bincount(of_max, minlength=size)
    sums = np.zeros((size, FORM + len(point.shape.limits)))
    sums[:, MAX] = np.bincount(of_max, minlength=size)
    sums[:, : RAND + 1] -= counts[:, None] * point.weights
    causes = problem.device.causes(point)
    for first in range(0, pairs.hits, _PART):
        part = slice(first, first + _PART)
        z, expected = (values[part].astype(np.float64) for values in (pairs.reading, pairs.expected))
        terms = _terms(z, expected, causes[part, 1:], point, pairs.range_max)
        for place, term in terms.items():
            sums[:, place] += np.bincount(of_hits[part], term, size)
    return sums, counts


def _terms(z: Floats, expected: Floats, parts: Floats, point: Point, range_max: float) -> dict[int, Floats]:
    """Return the gradient of each hit's log p by coordinate, without the weights' normalisation.

    ``parts`` holds the (m, 3) responsibilities of hit, short and rand for (m,) readings and expected ranges [m].
    """
    hit, short, rand = parts.T
    shape, mean = point.shape, np.clip(expected + point.bias, 0, range_max)
    _, by_sigma, by_mean = truncated(z - mean, mean, range_max, point.sigma, shape)
    by_bias = np.where(mean == expected + point.bias, by_mean, 0)
    ends = (z - mean) / point.sigma, mean / point.sigma, (range_max - mean) / point.sigma
    by_form = by_shape(*ends, shape.coordinates, shape.at, shape.limits)
    by_rate = ShortDensity(point.rate).by_log_rate(z, expected)
    return {
        HIT: hit, SHORT: short, RAND: rand,
        SIGMA: np.where(hit > 0, hit * by_sigma, 0.0), BIAS: np.where(hit > 0, hit * by_bias, 0.0),
        RATE: np.where(short > 0, short * by_rate, 0.0),
    } | {FORM + place: np.where(hit > 0, hit * each, 0.0) for place, each in enumerate(by_form)}  # fmt: skip
