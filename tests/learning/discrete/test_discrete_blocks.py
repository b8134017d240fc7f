"""Standard errors of the discrete model's causes over blocks of correlated readings."""

from __future__ import annotations

import numpy as np
import pytest

import gpusense as gs

TRUTH = gs.DiscreteCauses(lambda_short=0.1, lambda_rand=0.02, p_detect=0.9, sigma_hit=0.1)
RANGE_MAX, BINS = 10.0, 40


def draw(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Draw readings in the middles of bins, from the model's table."""
    rng = np.random.default_rng(seed)
    table = gs.DiscreteBeamModel(TRUTH, RANGE_MAX, BINS)
    rows = rng.integers(4, 36, count)
    steps = np.array([rng.choice(BINS + 1, p=table.probabilities[j]) for j in rows])
    return (steps + 0.5) * RANGE_MAX / BINS, (rows + 0.5) * RANGE_MAX / BINS


def learn(z: np.ndarray, expected: np.ndarray, blocks: np.ndarray | None = None) -> gs.DiscreteFit:
    fit = gs.DiscreteBeamModel.learn(z, expected, RANGE_MAX, BINS, blocks=blocks).fit
    assert fit is not None and fit.converged
    return fit


def test_errors_over_blocks() -> None:
    z, expected = draw(4000, 1)
    z[3] = np.nan
    once = learn(z, expected, np.arange(4000) // 2)
    plain = learn(z, expected)
    assert (once.blocks, plain.blocks) == (2000, 0) and plain.standard_errors == plain.independent_errors
    for name, error in plain.standard_errors.items():
        # Independent readings: errors over 2000 blocks agree within their own error.
        assert once.independent_errors[name] == error
        assert once.standard_errors[name] == pytest.approx(error, rel=0.15), name
    nine = np.repeat(np.arange(4000), 9)
    repeated = learn(np.repeat(z, 9), np.repeat(expected, 9), nine)
    single = learn(z, expected, np.arange(4000))
    for name, error in single.standard_errors.items():
        # Nine copies of a reading have the information of one, to the precision of differences.
        assert repeated.standard_errors[name] == pytest.approx(error, rel=2e-3), name
        assert repeated.independent_errors[name] == pytest.approx(single.independent_errors[name] / 3, rel=2e-3), name


def test_few_blocks_and_bad_input() -> None:
    z, expected = draw(400, 2)
    assert "standard errors are rough, from 4 blocks" in learn(z, expected, np.arange(400) // 100).status
    rule = "blocks: must be at least 2 with a reading that is not missing, got 1"
    for blocks, error, text in (
        (np.zeros(400, int), ValueError, rule),
        (np.zeros(3, int), ValueError, r"blocks: shape must be \(400,\), got \(3,\)"),
        (np.zeros(400), TypeError, "blocks: must hold integers, got dtype float64"),
    ):
        with pytest.raises(error, match=f"^{text}$"):
            learn(z, expected, blocks)
