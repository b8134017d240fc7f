"""Standard errors over blocks of correlated readings, and the offset of correct ranges."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support.learning_data import RANGE_MAX, TYPICAL, draw

import gpusense as gs


def errors(fit: gs.BeamFit) -> np.ndarray:
    return np.array(list(fit.standard_errors.values()))


def test_independent_readings_have_the_same_errors_in_blocks(needs) -> None:
    """Errors over 2000 blocks have a relative error of 1 / sqrt(2 * 2000) = 1.6 %, or more for long tails."""
    z, expected = draw(TYPICAL, 20_000, 3)
    fit = gs.fit_beam_parameters(z, expected, RANGE_MAX, backend=needs("opencl"), blocks=np.arange(20_000) // 10)
    independent = np.array([fit.independent_errors[name] for name in fit.standard_errors])
    np.testing.assert_allclose(errors(fit), independent, rtol=0.12)
    assert fit.blocks == 2000 and "if independent" in str(fit) and "over 2000 blocks" in str(fit)


def test_repeated_readings_know_no_more_than_one(needs) -> None:
    """Each block repeats a reading 9 times: errors equal those of single readings, 3 times the independent errors."""
    backend = needs("opencl")
    z, expected = draw(TYPICAL, 3000, 4)
    once = gs.fit_beam_parameters(z, expected, RANGE_MAX, backend=backend, blocks=np.arange(3000))
    labels = np.repeat(np.arange(3000), 9)
    fit = gs.fit_beam_parameters(np.repeat(z, 9), np.repeat(expected, 9), RANGE_MAX, backend=backend, blocks=labels)
    np.testing.assert_allclose(errors(fit), errors(once), rtol=1e-3)
    plain = gs.fit_beam_parameters(np.repeat(z, 9), np.repeat(expected, 9), RANGE_MAX, backend=backend)
    np.testing.assert_allclose(errors(plain), [fit.independent_errors[name] for name in fit.standard_errors], rtol=1e-9)
    assert plain.blocks == 0 and 2.5 < np.median(errors(fit) / errors(plain)) < 3.5
    assert fit.range_bias_error == pytest.approx(once.range_bias_error, rel=1e-3)


def test_bins_of_incidence_have_errors_over_blocks() -> None:
    z, expected = draw(TYPICAL, 800, 5)
    angles = np.random.default_rng(0).uniform(0, 1.5, 800)
    labels = np.arange(800) // 20
    fit = gs.fit_incidence_parameters(z, expected, angles, RANGE_MAX, bins=2, backend="numpy", blocks=labels)
    assert fit.pooled.blocks == 40 and all(own.blocks == 40 for own in fit.fits)
    alone = gs.fit_beam_parameters(z, expected, RANGE_MAX, backend="numpy", blocks=labels)
    np.testing.assert_allclose(errors(fit.pooled), errors(alone), rtol=1e-6)


def test_few_blocks_are_reported() -> None:
    z, expected = draw(TYPICAL, 300, 6)
    fit = gs.fit_beam_parameters(z, expected, RANGE_MAX, backend="numpy", blocks=np.arange(300) // 100)
    assert "standard errors are rough, from 3 blocks" in fit.status


@pytest.mark.parametrize(
    ("error", "message", "blocks"),
    [
        (TypeError, "blocks: must hold integers", [0.5, 1.0]),
        (ValueError, r"blocks: shape must be \(2,\), got \(3,\)", [0, 1, 2]),
        (ValueError, "blocks: must be at least 2 with a reading that is not missing, got 1", [3, 3]),
    ],
)
def test_bad_blocks_are_refused(error: type, message: str, blocks: list) -> None:
    with pytest.raises(error, match=message):
        gs.fit_beam_parameters([1.0, 2.0], [1.5, 2.0], 10.0, backend="numpy", blocks=blocks)


def long_tails(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Draw readings with an offset of 5 cm and four standard deviations; a fifth of them are random."""
    rng = np.random.default_rng(seed)
    expected = rng.uniform(1, 30, 5000)
    z = expected + 0.05 + rng.normal(0, 0.04, 5000) * rng.choice([0.5, 1, 2, 3], 5000)
    other = rng.uniform(size=5000) < 0.2
    z[other] = rng.uniform(0, 40, int(other.sum()))
    return z, expected


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_reported_offset_is_that_of_the_joint_fit(seed: int, needs) -> None:
    z, expected = long_tails(seed)
    backend = needs("opencl")
    plain = gs.fit_beam_parameters(z, expected, 40.0, backend=backend)
    joint = gs.fit_beam_parameters(z, expected, 40.0, backend=backend, range_bias=True)
    assert abs(plain.range_bias - 0.05) < 4 * plain.range_bias_error < 0.01
    assert plain.range_bias == pytest.approx(joint.range_bias, abs=1e-3 * joint.range_bias_error)
    assert plain.range_bias_error == pytest.approx(joint.range_bias_error, rel=1e-4)
    assert not plain.bias_fitted and plain.log_likelihood < joint.log_likelihood


def test_no_offset_is_reported_away_from_an_optimum() -> None:
    z, expected = draw(TYPICAL, 400, 12)
    for options in ({"max_iterations": 1}, {"method": "em-book"}):
        fit = gs.fit_beam_parameters(z, expected, 10.0, backend="numpy", **options)
        assert math.isnan(fit.range_bias) and math.isnan(fit.range_bias_error)
        assert fit.to_dict()["range_bias"] is None and "nan" not in str(fit)
