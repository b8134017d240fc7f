"""Fits of likelihoods with several maxima find the highest, or the status reports a higher maximum."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize
from support.learning_data import problem_of

import gpusense as gs
from gpusense.evaluation.worlds import sample_readings
from gpusense.learning.beam.em import Climb, Watch, climb_em
from gpusense.learning.beam.optimum import Search
from gpusense.learning.beam.pairs import Point
from gpusense.learning.beam.problem import Problem
from gpusense.models.scan.densities import log_mixture


def two_modes() -> tuple[np.ndarray, np.ndarray]:
    """Draw 25 readings of a wall at 2 m and 25 of another object at 4 m, both within a centimetre."""
    rng = np.random.default_rng(0)
    return np.r_[rng.normal(2, 0.01, 25), rng.normal(4, 0.01, 25)], np.full(50, 2.0)


def brute_force(z: np.ndarray, expected: np.ndarray, range_max: float, count: int) -> float:
    """Return the highest log-likelihood that Nelder and Mead's simplex finds from random starts, without z_max."""
    rng = np.random.default_rng(1)

    def loss(x: np.ndarray) -> float:
        weights = np.exp(x[:3] - x[:3].max())
        hit, short, rand = weights / weights.sum()
        shapes = {"sigma_hit": np.exp(x[3]), "lambda_short": np.exp(np.clip(x[4], -7, 7))}
        weight = {"z_hit": hit, "z_short": short, "z_max": 0.0, "z_rand": rand}
        with np.errstate(divide="ignore"):
            return -float(log_mixture(z, expected, range_max=range_max, **weight, **shapes).sum())

    best = np.inf
    for _ in range(count):
        x = np.r_[rng.normal(0, 1, 3), rng.uniform(np.log(1e-3), np.log(range_max)), rng.normal(0, 1)]
        best = min(best, minimize(loss, x, method="Nelder-Mead", options={"maxiter": 2000, "maxfev": 2000}).fun)
    return -best


@pytest.fixture(scope="module")
def highest() -> float:
    """Return the highest log-likelihood of two modes."""
    return brute_force(*two_modes(), 8.0, 20)


def test_the_status_reports_that_another_start_is_better() -> None:
    z, expected = two_modes()
    wide = gs.BeamParameters(0.98, 0.0, 0.0, 0.02, 1.4, 1.0)
    fit = gs.fit_beam_parameters(z, expected, 8.0, initial=wide, backend="numpy")
    assert (
        fit.log_likelihood < -80 and "another start is at least" in fit.status and "leave out 'initial'" in fit.status
    )
    best = gs.fit_beam_parameters(z, expected, 8.0, backend="numpy")
    again = gs.fit_beam_parameters(z, expected, 8.0, initial=best.parameters, backend="numpy")
    assert again.log_likelihood == pytest.approx(best.log_likelihood, abs=1e-6) and again.status == best.status
    several = gs.fit_beam_parameters(z, expected, 8.0, backend="numpy", restarts=5)
    assert "of 6 starts ended lower, by up to 80" in several.status


def scene(seed: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Draw readings with few short ones: the likelihood hardly depends on z_short."""
    rng = np.random.default_rng(seed)
    range_max, n = float(rng.choice([10, 50, 82])), int(rng.choice([200, 1000, 4000]))
    expected = (rng.uniform(0.02, 0.98, n) if seed % 2 == 0 else rng.uniform(0.02, 0.3, n)) * range_max
    weights = rng.dirichlet([6, 0.4, 0.2, 0.6])
    shapes = float(np.exp(rng.uniform(-5, -1))), float(np.exp(rng.uniform(-2, 4)))
    truth = gs.BeamParameters(*map(float, weights), *shapes)
    return sample_readings(expected, range_max, truth, rng), expected, range_max


@pytest.mark.parametrize("number", [2, 41, 53, 65])
def test_methods_agree_where_few_readings_are_short(number: int, needs) -> None:
    z, expected, range_max = scene(number)
    backend = needs("opencl")
    fits = [gs.fit_beam_parameters(z, expected, range_max, method=m, backend=backend) for m in ("em", "hill_climb")]
    assert all(fit.converged for fit in fits)
    assert fits[0].log_likelihood == pytest.approx(fits[1].log_likelihood, abs=1e-2)


def test_a_cause_that_a_search_left_out_too_early_comes_back() -> None:
    """The first run ends without z_short, where the gradient within the remaining causes vanishes."""
    rng = np.random.default_rng(3)
    expected = rng.uniform(4, 9, 600)
    z = sample_readings(expected, 10.0, gs.BeamParameters(0.7, 0.2, 0.0, 0.1, 0.1, 1.0), rng)
    problem, runs = problem_of(z, expected, fit_bias=False), []

    def climb(problem: Problem, start: Point, watch: Watch) -> Climb:
        weights = np.where(np.arange(4) == 1, 0.0 if not runs else start.weights[1], start.weights)
        runs.append(start)
        start = Point(weights / weights.sum(), start.sigma, start.rate)
        return climb_em(problem, start, max_iterations=500, tolerance=1e-8, watch=watch)

    seen: list[int] = []
    start = Point(np.array([0.5, 0.2, 0.0, 0.3]), 0.2, 1.0)
    end = Search(problem, climb, lambda iteration, value: seen.append(iteration)).run(start, [], chosen=True)
    best = gs.fit_beam_parameters(z, expected, 10.0, backend="numpy")
    assert len(runs) == 2 and end.value.point.weights[1] > 0.1
    assert end.value.objective == pytest.approx(best.log_likelihood, abs=1e-6)
    assert seen == list(range(1, len(end.trace)))
    assert (np.diff(end.trace) >= -1e-9 * abs(end.value.objective)).all()


@pytest.mark.long
@pytest.mark.parametrize("range_max", [10.0, 80.0])
@pytest.mark.parametrize("count", [1, 2, 200])
def test_hill_climbing_does_not_warn_where_all_readings_are_0(count: int, range_max: float, needs, recwarn) -> None:
    backend = needs("opencl")
    fit = gs.fit_beam_parameters(
        np.zeros(count), np.full(count, 5.0), range_max, method="hill_climb", backend=backend, max_iterations=50
    )
    # Readings of exactly 0 raise a warning.
    others = [warning for warning in recwarn.list if not issubclass(warning.category, gs.PlausibilityWarning)]
    assert np.isfinite(fit.log_likelihood) and not others
