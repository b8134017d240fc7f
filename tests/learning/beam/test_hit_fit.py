"""Fits of Student's t as the shape of correct ranges."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import minimize

import gpusense as gs
from gpusense.models.scan.densities import log_mixture

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
