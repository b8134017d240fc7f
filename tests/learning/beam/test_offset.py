"""The offset of correct ranges that a fit reports outside its parameters."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support.learning_data import TYPICAL, draw

import gpusense as gs


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
