"""Readings that do not determine all parameters, or make the likelihood unbounded, and bad arguments."""

from __future__ import annotations

import numpy as np
import pytest
from support.learning_data import RANGE_MAX, TYPICAL, draw

import gpusense as gs
from gpusense.learning.beam.pairs import range_resolution
from gpusense.learning.beam.problem import NOTHING

RNG = np.random.default_rng(0)
AHEAD = RNG.uniform(1, 9, 200)
NOISE = RNG.normal(0, 0.1, 200)
FIVE = np.full(200, 5.0)

# Readings, expected ranges, and what must be held.
DATA = {
    "all max": (np.full(200, np.inf), AHEAD, "z_max: every reading has this cause"),
    "one max": (np.array([np.inf]), np.array([3.0]), "sigma_hit: kept"),
    "all equal to z*": (AHEAD, AHEAD, "sigma_hit: at its lower bound"),
    "all the same": (FIVE, FIVE, "sigma_hit: at its lower bound"),
    "one reading": (np.array([4.9]), np.array([5.0]), "lambda_short: kept"),
    "one of ten not missing": (np.r_[np.full(9, np.nan), 5.0], np.full(10, 5.1), "z_short: no reading needs"),
    "two readings": (np.array([4.9, 3.05]), np.array([5.0, 3.0]), "z_rand: no reading needs this cause"),
    "one z*": (FIVE + NOISE, FIVE, "z_max: no reading needs this cause"),
    "all beyond z*": (AHEAD + np.abs(NOISE), AHEAD, "z_short: no reading needs this cause"),
    "all 0": (np.zeros(200), AHEAD, "lambda_short: at its upper bound"),
    "z* = 0": (np.abs(NOISE), np.zeros(200), "z_short: no reading needs this cause"),
    "z* = range_max": (AHEAD, np.full(200, RANGE_MAX), "z_max: no reading needs this cause"),
    "one short": (np.r_[AHEAD[1:], 0.2], np.r_[AHEAD[1:], 5.0], "sigma_hit: at its lower bound"),
    "denormal": (np.full(200, 1e-310), AHEAD, "lambda_short: at its upper bound"),
    "max and z*": (np.where(NOISE > 0, np.inf, AHEAD), AHEAD, "sigma_hit: at its lower bound"),
}


def reasons(fit: gs.BeamFit) -> str:
    return "; ".join(f"{name}: {reason}" for name, reason in fit.held.items())


@pytest.mark.sampled(0.5)
@pytest.mark.parametrize(
    ("name", "method"),
    [
        *((name, method) for name in DATA for method in ("em", "gradient")),
        ("all max", "hill_climb"),
        ("all beyond z*", "hill_climb"),
    ],
)
def test_degenerate_readings_give_finite_parameters_and_a_reason(name: str, method: str) -> None:
    z, expected, said = DATA[name]
    fit = gs.fit_beam_parameters(z, expected, RANGE_MAX, method=method, backend="numpy")
    values = fit.parameters.to_dict()
    assert np.isfinite(list(values.values())).all() and np.isfinite(fit.log_likelihood)
    assert np.isfinite(fit.range_bias)
    assert fit.converged and said in reasons(fit)
    for parameter, reason in fit.held.items():
        assert not np.isfinite(fit.standard_errors[parameter]), parameter
        assert reason in fit.status
    for parameter, error in fit.standard_errors.items():
        assert (parameter in fit.held) or error > 0, (parameter, error)
    if method == "em":
        assert (np.diff(fit.trace) >= -1e-9 * abs(fit.log_likelihood)).all()
        assert str(fit)


@pytest.mark.long
def test_degenerate_readings_are_alike_on_every_backend(backend: str) -> None:
    for name, (z, expected, said) in DATA.items():
        fit = gs.fit_beam_parameters(z, expected, RANGE_MAX, backend=backend)
        assert said in reasons(fit), name


@pytest.mark.parametrize("name", ["all equal to z*", "all max", "all beyond z*"])
def test_the_book_breaks_and_says_so(name: str) -> None:
    z, expected, _ = DATA[name]
    fit = gs.fit_beam_parameters(z, expected, RANGE_MAX, method="em-book", backend="numpy")
    assert not fit.converged and "where the book's form ends" in fit.status
    assert np.isfinite(list(fit.parameters.to_dict().values())).all()


def test_sigma_stays_above_what_rounding_hides() -> None:
    rounded = np.round((FIVE + 0.1 * NOISE) / 0.05) * 0.05
    assert range_resolution(rounded) == pytest.approx(0.05)
    exact = np.round(AHEAD / 0.05) * 0.05
    fit = gs.fit_beam_parameters(exact, exact, RANGE_MAX, backend="numpy")
    assert fit.parameters.sigma_hit == pytest.approx(0.05 / np.sqrt(12))
    assert range_resolution(AHEAD) == 0 and range_resolution(FIVE) == 0 and range_resolution(AHEAD[:0]) == 0
    assert range_resolution(rounded.astype(np.float32)) == pytest.approx(0.05, rel=1e-4)
    # Repeated values that share no step.
    assert range_resolution(np.repeat(AHEAD[:50], 2)) == 0


def test_bounds_and_starts_are_kept() -> None:
    z, expected = draw(TYPICAL, 800, 5)
    fit = gs.fit_beam_parameters(
        z, expected, RANGE_MAX, backend="numpy", sigma_bounds=(0.3, 1.0), lambda_bounds=(0.1, 0.4)
    )
    assert (fit.parameters.sigma_hit, fit.parameters.lambda_short) == (0.3, 0.4)
    assert "lower bound 0.3" in fit.held["sigma_hit"] and "upper bound 0.4" in fit.held["lambda_short"]
    without = gs.BeamParameters(0.8, 0.0, 0.1, 0.1, 0.2, 1.0)
    fit = gs.fit_beam_parameters(z, expected, RANGE_MAX, backend="numpy", initial=without)
    assert fit.parameters.z_short == 0 and fit.parameters.lambda_short == 1.0 and NOTHING < 1


@pytest.mark.parametrize("method", ["em", "gradient"])
def test_short_readings_that_are_uniform_end_at_the_lower_bound(method: str) -> None:
    """Rounding may leave the rate of the gradient's search an ulp above the bound."""
    for seed in (1, 5):
        rng = np.random.default_rng(seed)
        expected = rng.uniform(3, 9, 400)
        z, short = expected + rng.normal(0, 0.05, 400), rng.random(400) < 0.2
        z[short] = rng.uniform(0, 1, short.sum()) * expected[short]
        fit = gs.fit_beam_parameters(z, expected, RANGE_MAX, method=method, backend="numpy")
        assert fit.converged and fit.held["lambda_short"] == "at its lower bound 0.0001"


BAD = {
    "ranges: must hold a reading": dict(ranges=[np.nan, -1.0]),
    "expected: shape must be that of ranges": dict(expected=[1.0]),
    "expected: every value must be in": dict(expected=[1.0, 10.5]),
    "expected: every value must be in .* nan": dict(expected=[1.0, np.nan]),
    "range_min: must be": dict(range_min=11.0),
    "sigma_bounds: must be two": dict(sigma_bounds=(1.0, 0.5)),
    "initial: must give every reading a cause": dict(initial=gs.BeamParameters(0, 0, 1, 0)),
    "initial: must make every reading possible": dict(initial=gs.BeamParameters(0, 1, 0, 0), ranges=[1.0, 3.0]),
    "range_bias: must be False with method": dict(method="em-book", range_bias=True),
}


@pytest.mark.parametrize("message", BAD)
def test_bad_values_are_refused(message: str) -> None:
    arguments = dict(ranges=[1.0, 2.0], expected=[1.5, 2.0], range_max=10.0, backend="numpy") | BAD[message]
    with pytest.raises(ValueError, match=message):
        gs.fit_beam_parameters(**arguments)
