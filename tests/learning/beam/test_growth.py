"""Fits of deviations that grow with range, and of Student's t as the shape of correct ranges."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import minimize
from support.gradients import check_gradients

import gpusense as gs
from gpusense.learning.beam import growth
from gpusense.models.scan.densities import log_mixture

TRUTH = gs.BeamParameters(0.7, 0.12, 0.08, 0.1, sigma_hit=0.02, lambda_short=0.4, range_bias=0.03, sigma_growth=0.015)


def draw(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    expected = rng.uniform(0.3, 9.5, count)
    cause = rng.choice(4, count, p=[TRUTH.z_hit, TRUTH.z_short, TRUTH.z_max, TRUTH.z_rand])
    hit = expected + TRUTH.range_bias + (TRUTH.sigma_hit + TRUTH.sigma_growth * expected) * rng.normal(size=count)
    short = -np.log1p(-rng.random(count) * -np.expm1(-TRUTH.lambda_short * expected)) / TRUTH.lambda_short
    return np.choose(cause, [hit, short, np.full(count, 10.0), rng.uniform(0, 10, count)]), expected


@pytest.mark.parametrize("bias", [False, True])
def test_gradients_are_those_of_differences(bias: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[Any] = []
    real = growth.hosted.maximize
    monkeypatch.setattr(growth.hosted, "maximize", lambda p, *rest: seen.append(p) or real(p, *rest))
    z, expected = draw(500, 1)
    gs.fit_beam_parameters(z, expected, 10.0, sigma_growth=True, range_bias=bias, backend="numpy")
    theta = np.array([0.1, 0.2, 0.15, np.log(0.1), 0.02, np.log(0.5), *([0.05] if bias else [])])
    check_gradients(seen[0], theta)


def test_all_parameters_are_found(needs) -> None:
    z, expected = draw(6000, 2)
    z[7] = np.nan
    options: Any = dict(backend=needs("opencl"), range_bias=True)
    plain = gs.fit_beam_parameters(z, expected, 10.0, **options)
    fit = gs.fit_beam_parameters(z, expected, 10.0, sigma_growth=True, responsibilities=True, **options,
                                 blocks=np.arange(6000) // 10)  # fmt: skip
    assert fit.converged and fit.log_likelihood > plain.log_likelihood + 100
    found = fit.parameters.to_dict()
    errors = fit.standard_errors | {"range_bias": fit.range_bias_error}
    for name, value in TRUTH.to_dict().items():
        assert abs(found[name] - value) < 4 * errors[name] < 0.2, name
        # Errors over 600 blocks have a standard error of some percent.
        assert errors[name] == pytest.approx(fit.independent_errors[name], rel=0.2)
    assert "sigma_growth" in str(fit) and "over 600 blocks" in str(fit)
    np.testing.assert_allclose(np.delete(fit.responsibilities, 7, axis=0).sum(axis=1), 1, rtol=1e-9)
    # The model's log-likelihood at poses of known expected ranges: one beam towards a wall.
    grid = gs.OccupancyGrid([[0] * 120 + [100]], 0.1)
    scanner = gs.Scanner([0.0], range_max=10.0)
    poses = np.column_stack([12.0 - expected[:200], np.full(200, 0.05), np.zeros(200)])
    model = gs.BeamModel(grid, scanner, fit.parameters, backend="numpy", precision="float64")
    total = sum(float(model.log_likelihood(p[None], [r])[0]) for p, r in zip(poses, z[:200], strict=True))
    walls = model.expected_ranges(poses)[:, 0]
    again = gs.fit_beam_parameters(z[:200], walls, 10.0, sigma_growth=True, range_bias=True, backend="numpy")
    best = gs.BeamModel(grid, scanner, again.parameters, backend="numpy", precision="float64")
    own = sum(float(best.log_likelihood(p[None], [r])[0]) for p, r in zip(poses, z[:200], strict=True))
    assert own == pytest.approx(again.log_likelihood, rel=1e-9) and own >= total


def test_without_growth_the_fit_is_the_plain_one() -> None:
    rng = np.random.default_rng(3)
    expected = rng.uniform(1, 9, 3000)
    # If the deviation falls with range, growth is at its bound, 0.
    z = expected + rng.normal(0, 0.3 - 0.03 * expected)
    plain = gs.fit_beam_parameters(z, expected, 10.0, backend="numpy")
    fit = gs.fit_beam_parameters(z, expected, 10.0, sigma_growth=True, backend="numpy")
    assert fit.parameters.sigma_growth == 0 and fit.held["sigma_growth"] == "at a bound"
    assert fit.log_likelihood == pytest.approx(plain.log_likelihood, abs=1e-6)
    assert fit.parameters.sigma_hit == pytest.approx(plain.parameters.sigma_hit, rel=1e-5)
    assert fit.range_bias == pytest.approx(plain.range_bias, abs=1e-6)
    assert fit.range_bias_error == pytest.approx(plain.range_bias_error, rel=1e-3)


def test_the_independent_error_of_the_offset_is_that_with_growth() -> None:
    z, expected = draw(800, 4)
    fit = gs.fit_beam_parameters(z, expected, 10.0, sigma_growth=True, backend="numpy")
    assert fit.converged and fit.range_bias_error == fit.independent_errors["range_bias"] > 0


@pytest.mark.parametrize("options", [{}, {"hit": "student"}, {"range_bias": True}], ids=str)
def test_readings_at_one_range_do_not_determine_the_growth(options: dict[str, Any]) -> None:
    """Only sigma_hit + sigma_growth z* is determined; over blocks, gradients vanish along the other direction."""
    rng = np.random.default_rng(0)
    z, blocks = 4 + rng.normal(0, 0.1, 400), np.arange(400) // 20
    for labels in (None, blocks):
        fit = gs.fit_beam_parameters(
            z, np.full(400, 4.0), 8.0, sigma_growth=True, blocks=labels, backend="numpy", **options
        )
        for name in ("sigma_hit", "sigma_growth"):
            assert fit.standard_errors[name] == fit.independent_errors[name] == np.inf
            assert fit.held[name] == "the readings do not determine it"
        assert np.isfinite(fit.range_bias_error)


def test_bad_input() -> None:
    with pytest.raises(TypeError, match=r"^sigma_growth: must be True or False, got 1$"):
        gs.fit_beam_parameters([1.0], [1.0], 10.0, sigma_growth=1)
    with pytest.raises(ValueError, match=r"^sigma_growth: must be False with method 'em-book', which has no growth"):
        gs.fit_beam_parameters([1.0], [1.0], 10.0, sigma_growth=True, method="em-book")
    none = gs.fit_beam_parameters([10.0], [1.0], 10.0, sigma_growth=True, backend="numpy")
    assert none.held["sigma_growth"] == "no range determines it" and none.parameters.z_max == 1


RANGE = 8.0
NORMAL = gs.BeamParameters(0.8, 0.1, 0.05, 0.05, 0.05, 0.4)
STUDENT = NORMAL.replace(hit="student", hit_dof=3.0)
COUNT = 4000


@functools.cache
def drawn(truth: gs.BeamParameters, count: int = COUNT) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(11)
    expected = rng.uniform(1, 7, count)
    return gs.worlds.sample_readings(expected, RANGE, truth, rng), expected


@functools.cache
def fitted(truth: gs.BeamParameters, hit: str) -> gs.BeamFit:
    return gs.fit_beam_parameters(*drawn(truth), RANGE, backend="numpy", hit=hit)


def test_degrees_of_freedom_are_found() -> None:
    fit = fitted(STUDENT, "student")
    assert fit.converged and fit.parameters.hit == "student"
    for name, value in STUDENT.to_dict().items():
        if name != "hit":
            assert abs(getattr(fit.parameters, name) - value) < 4 * fit.standard_errors[name], name
    assert 0 < fit.standard_errors["hit_dof"] < 0.5
    assert "hit_dof" in str(fit) and "hit='student'" in repr(fit) and "hit_dof" in fit.to_dict()["standard_errors"]


def test_the_likelihood_never_falls_and_is_that_of_the_mixture() -> None:
    fit = fitted(STUDENT, "student")
    assert len(fit.trace) > 2 and (np.diff(fit.trace) >= -1e-9).all()
    z, expected = drawn(STUDENT)
    log_p = log_mixture(np.minimum(z, RANGE), expected, range_max=RANGE, **fit.parameters.to_dict())
    assert log_p.sum() == pytest.approx(fit.log_likelihood, rel=1e-9)


@functools.cache
def fitted_by_scipy(count: int) -> tuple[float, np.ndarray]:
    """Return the largest log-likelihood by SciPy's t distribution, and its location by a simplex from the truth."""
    z, expected = (each[:count] for each in drawn(STUDENT))
    none = np.isinf(z)

    def loss(x: np.ndarray) -> float:
        weights = np.exp(np.append(x[:3], 0.0))
        hit, short, top, rand = weights / weights.sum()
        sigma, rate, dof = np.exp(x[3:])
        law = stats.t(dof, expected, sigma)
        p = hit * law.pdf(z) / (law.cdf(RANGE) - law.cdf(0)) + rand / RANGE
        short_law = stats.truncexpon(rate * expected, scale=1 / rate)
        p = np.where(none, top, p + short * short_law.pdf(np.where(none, 0.0, z)))
        return -float(np.log(p).sum())

    start = np.log([0.8 / 0.05, 0.1 / 0.05, 1.0, 0.05, 0.4, 3.0])
    best = minimize(loss, start, method="Nelder-Mead", options={"xatol": 1e-5, "fatol": 1e-7, "maxiter": 4000})
    return -best.fun, best.x


@pytest.mark.long
def test_the_fit_is_that_of_scipy(backend: str) -> None:
    z, expected = (each[:1500] for each in drawn(STUDENT))
    blocks = np.arange(1500) // 5
    fit = gs.fit_beam_parameters(z, expected, RANGE, backend=backend, hit="student", blocks=blocks)
    best, at = fitted_by_scipy(1500)
    assert fit.converged and best - 1e-6 <= fit.log_likelihood <= best + 1e-4
    for name, value in zip(("sigma_hit", "lambda_short", "hit_dof"), np.exp(at[3:]), strict=True):
        assert getattr(fit.parameters, name) == pytest.approx(value, rel=0.01 * fit.independent_errors[name] / value)
    # Standard errors equal those from SciPy's second derivatives, and over blocks of independent readings.
    assert fit.standard_errors["hit_dof"] == pytest.approx(fit.independent_errors["hit_dof"], rel=0.3)


def test_without_ranges_nothing_determines_the_shape() -> None:
    fit = gs.fit_beam_parameters([RANGE] * 5, [4.0] * 5, RANGE, backend="numpy", hit="student")
    assert fit.parameters.hit == "student" and fit.held["hit_dof"] == "no range determines it"
