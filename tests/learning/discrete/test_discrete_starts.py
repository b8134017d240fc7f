"""Learning the discrete model from likelihoods with several maxima, or independent of some causes."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

import gpusense as gs
from gpusense.learning.discrete.fit import count_pairs

BINS = 989


def two_widths(seed: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Draw narrow and ten times wider readings, a few at random and a few without return."""
    rng = np.random.default_rng(seed)
    range_max = float(rng.choice([8, 20, 50, 100]))
    expected = rng.uniform(0.05, 0.6, 2000) * range_max
    sigma = range_max * float(np.exp(rng.uniform(np.log(1e-4), np.log(0.01))))
    offset = range_max * float(rng.choice([0, 0.002, 0.01, 0.05]))
    wide = float(rng.choice([0.1, 0.3, 0.5, 0.7]))
    z, u = expected + rng.normal(0, sigma, 2000), rng.uniform(size=2000)
    z = np.where(u < wide, expected + offset + rng.normal(0, 10 * sigma, 2000), z)
    z[u > 0.93] = rng.uniform(0, range_max, int((u > 0.93).sum()))
    z[u > 0.98] = np.inf
    return np.abs(z), expected, range_max


@pytest.mark.long
@pytest.mark.sampled(0.5)
@pytest.mark.parametrize("seed", [4, 5])
def test_no_point_of_a_grid_is_likelier_than_the_fit(seed: int) -> None:
    z, expected, range_max = two_widths(seed)
    table = gs.DiscreteBeamModel.learn(z, expected, range_max, BINS)
    assert table.fit is not None and table.fit.converged
    counts = count_pairs(z, expected, range_max, BINS)
    rates = np.array([1e-4, 1e-2, 0.3, 3.0]) / range_max * 10
    grid = itertools.product(rates, rates, (0.1, 0.3, 0.6, 0.95), np.geomspace(2e-4, 0.2, 10) * range_max)
    highest = max(counts.log_likelihood(gs.DiscreteCauses(*map(float, causes))) for causes in grid)
    assert table.fit.log_likelihood > highest


def test_a_flat_direction_leaves_the_other_standard_errors() -> None:
    """The obstacle is in the last step: both rates end there, and only their sum matters."""
    rng = np.random.default_rng(0)
    expected = np.full(3000, 5 * (1 - 0.5 / 50))
    z, u = expected + rng.normal(0, 0.1, 3000), rng.uniform(size=3000)
    z[u < 0.3] = rng.uniform(0, 5, int((u < 0.3).sum()))
    z[u > 0.9] = np.inf
    fit = gs.DiscreteBeamModel.learn(z, expected, 5.0, 50).fit
    assert fit is not None and fit.converged
    errors = fit.standard_errors
    assert math.isnan(errors["lambda_short"]) and math.isnan(errors["lambda_rand"])
    assert "the readings do not determine lambda_short, lambda_rand" in fit.status
    # Fixing either rate removes the flat direction.
    counts = count_pairs(z, expected, 5.0, 50)
    causes = gs.DiscreteBeamModel.learn(z, expected, 5.0, 50).causes
    at = np.array([causes.lambda_short + causes.lambda_rand, causes.p_detect, causes.sigma_hit])
    step = np.diag(1e-3 * at)

    def log_p(x: np.ndarray) -> float:
        return counts.log_likelihood(gs.DiscreteCauses(0.0, *map(float, x)))

    curve = np.array([
        [(log_p(at + a + b) - log_p(at + a - b) - log_p(at - a + b) + log_p(at - a - b)) / (4e-6 * x * y)
         for b, y in zip(step, at, strict=True)] for a, x in zip(step, at, strict=True)
    ])  # fmt: skip
    wanted = np.sqrt(np.diagonal(np.linalg.inv(-curve)))[1:]
    np.testing.assert_allclose([errors["p_detect"], errors["sigma_hit"]], wanted, rtol=0.01)
