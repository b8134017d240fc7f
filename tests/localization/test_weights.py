"""Log-likelihoods to weights, and resampling."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import binomtest, chisquare

from gpusense.localization.weights import normalize_weights, resample

WEIGHTS = np.random.default_rng(1).random(1000)


def test_weights_of_hand_computed_values():
    result = normalize_weights([math.log(1.0), math.log(3.0), -math.inf])
    np.testing.assert_allclose(result.weights, [0.25, 0.75, 0.0], rtol=1e-15)
    assert result.log_evidence == pytest.approx(math.log(4 / 3), rel=1e-15)
    assert result.effective_sample_size == pytest.approx(1 / (0.25**2 + 0.75**2), rel=1e-15)
    assert not result.degenerate


@pytest.mark.parametrize("level", [-1e9, -1e5, 0.0, 1e5, 1e9])
def test_any_level_of_log_likelihood_gives_the_same_weights(level):
    log_p = np.array([0.0, -1.0, -2.0, -800.0])
    shifted = normalize_weights(log_p + level)
    lost = 1e-6 if abs(level) == 1e9 else 1e-9
    np.testing.assert_allclose(shifted.weights, normalize_weights(log_p).weights, rtol=lost)
    assert abs(shifted.weights.sum() - 1) <= 1e-12


def test_a_million_float32_log_likelihoods_sum_to_one():
    log_p = np.random.default_rng(0).normal(-4e5, 30, 1_000_000).astype(np.float32)
    result = normalize_weights(log_p)
    assert abs(result.weights.sum() - 1) <= 1e-12
    assert 1 <= result.effective_sample_size <= 1_000_000
    assert math.isfinite(result.log_evidence)


def test_an_impossible_scan_is_flagged_and_uniform():
    result = normalize_weights(np.full(4, -np.inf))
    assert result.degenerate
    assert result.weights.tolist() == [0.25] * 4
    assert result.log_evidence == -math.inf
    assert result.effective_sample_size == 4


@settings(max_examples=200, deadline=None)
@given(
    st.lists(st.floats(0, 1e6), min_size=1, max_size=50).filter(lambda w: max(w) > 1e-3),
    st.integers(0, 500),
    st.integers(0, 2**32 - 1),
)
def test_each_particle_appears_as_often_as_its_weight_says(weights, count, seed):
    chosen = resample(weights, count, np.random.default_rng(seed))
    assert len(chosen) == count
    assert (np.diff(chosen) >= 0).all()
    expected = count * np.array(weights) / np.sum(weights)
    appearances = np.bincount(chosen, minlength=len(weights))
    assert (np.abs(appearances - expected) < 1 + 1e-6).all()
    assert (appearances[np.array(weights) == 0] == 0).all()


@pytest.mark.parametrize("weights", [WEIGHTS, np.array([1e-12, 0, 1, 3, 3]), np.full(7, 1 / 7), np.array([1.0])])
@pytest.mark.parametrize("count", [1, 7, 4000])
def test_residual_draws_keep_whole_copies(weights, count):
    chosen = resample(weights, count, 0, method="residual")
    copies = np.bincount(chosen, minlength=len(weights))
    assert len(chosen) == count and (np.diff(chosen) >= 0).all() and (copies[weights == 0] == 0).all()
    assert (copies >= np.floor(count * weights / weights.sum() - 1e-9)).all()


def test_the_rest_of_residual_draws_and_strata_have_their_distributions():
    weights, rng, repeats = np.array([0.55, 0.3, 0.15]), np.random.default_rng(4), 4000
    # 5 w = 2.75, 1.5, 0.75: two of the remainders, 0.75, 0.5 and 0.75, are drawn in turn.
    rest = [resample(weights, 5, rng, method="residual") for _ in range(repeats)]
    extra = [tuple(np.bincount(chosen, minlength=3) - (2, 1, 0)) for chosen in rest]
    p = np.array([0.75, 0.5, 0.75]) / 2
    wanted = {(2, 0, 0): p[0] ** 2, (0, 2, 0): p[1] ** 2, (0, 0, 2): p[2] ** 2, (1, 1, 0): 2 * p[0] * p[1],
              (1, 0, 1): 2 * p[0] * p[2], (0, 1, 1): 2 * p[1] * p[2]}  # fmt: skip
    found = [extra.count(case) for case in wanted]
    assert sum(found) == repeats
    assert chisquare(found, repeats * np.array(list(wanted.values()))).pvalue > 1e-3
    # Strata of 0.25: the third holds 0.05 of the first particle and 0.2 of the second, the last 0.1 and 0.15.
    strata = np.array([resample(weights, 4, rng, method="stratified") for _ in range(repeats)])
    assert (strata[:, :2] == 0).all() and set(strata[:, 2]) == {0, 1} and set(strata[:, 3]) == {1, 2}
    for column, value, share in ((2, 0, 0.2), (3, 1, 0.4)):
        assert binomtest(int((strata[:, column] == value).sum()), repeats, share).pvalue > 1e-3
    assert abs(np.corrcoef(strata[:, 2], strata[:, 3])[0, 1]) < 0.07
    with pytest.raises(ValueError, match="method: must be"):
        resample(weights, 4, 0, method="multinomial")


def test_resampling_a_million_equal_weights_takes_each_once():
    chosen = resample(np.full(1_000_000, 1e-6), 1_000_000, np.random.default_rng(3))
    np.testing.assert_array_equal(chosen, np.arange(1_000_000))


def test_generators_of_every_kind_are_advanced():
    for rng in (np.random.default_rng(0), np.random.RandomState(0), np.random.PCG64(0)):
        assert len({tuple(resample(WEIGHTS, 5, rng)) for _ in range(20)}) > 10
    same = [resample(WEIGHTS, 5, np.random.RandomState(3)) for _ in range(2)]
    np.testing.assert_array_equal(*same)
    assert len({tuple(resample(WEIGHTS, 5)) for _ in range(20)}) > 10
