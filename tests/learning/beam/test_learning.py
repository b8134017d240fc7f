"""Fits of the beam model's parameters against the truth, against each other, and on every backend."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support.fit_scenes import learning_scenes
from support.learning_data import RANGE_MAX, TYPICAL, draw, starts

import gpusense as gs
from gpusense.evaluation.tolerances import TOLERANCES
from gpusense.models.scan.densities import log_mixture

FAR = gs.BeamParameters(0.7, 0.1, 0.15, 0.05, 1.0, 0.3)
EQUAL = gs.BeamParameters(0.25, 0.25, 0.25, 0.25, 1.0, 1.0)
# A parameter is identified if its relative standard error is below this: its likelihood is then nearly normal.
IDENTIFIED = 0.3


def values(fit: gs.BeamFit) -> np.ndarray:
    return np.array(list(fit.parameters.to_dict().values()))


def errors(fit: gs.BeamFit) -> np.ndarray:
    return np.array(list(fit.standard_errors.values()))


def identified(fit: gs.BeamFit) -> np.ndarray:
    return np.isfinite(errors(fit)) & (errors(fit) < IDENTIFIED * values(fit))


def worst_fall(fit: gs.BeamFit) -> float:
    """Return the largest relative fall of the log-likelihood in an iteration."""
    return float(np.max(-np.diff(fit.trace), initial=0.0)) / abs(fit.log_likelihood)


@pytest.mark.slow
def test_fifty_scenes_from_mild_to_stiff(needs) -> None:
    backend = needs("opencl")
    off = []
    for number, scene in enumerate(learning_scenes(50)):
        z, expected = scene.draw(1500, np.random.default_rng(number))
        fit = gs.fit_beam_parameters(z, expected, scene.range_max, backend=backend)
        assert fit.converged, (scene.name, fit.status)
        assert worst_fall(fit) <= TOLERANCES["exact EM falls"].value, scene.name
        truth = np.array(list(scene.parameters.to_dict().values()))
        known = identified(fit)
        off += list((values(fit) - truth)[known] / errors(fit)[known])
        # The truth is never better than the fit.
        at_truth = log_mixture(
            np.minimum(z, scene.range_max), expected, range_max=scene.range_max, **scene.parameters.to_dict()
        ).sum()
        assert fit.log_likelihood >= at_truth - 1e-9 * abs(at_truth), scene.name
    off = np.array(off)
    assert len(off) > 200
    assert np.mean(np.abs(off) <= 3) >= 0.95
    # Standard errors are neither too small nor too large: 240 squares of unlike scenes have a mean of 1 +- 0.1.
    assert 0.75 < np.sqrt(np.mean(off**2)) < 1.25


@pytest.mark.long_on("warp")
@pytest.mark.sampled(0.4)
@pytest.mark.parametrize(("truth", "span"), [(TYPICAL, (0.1, 0.9)), (FAR, (0.8, 1.0))], ids=["typical", "far"])
def test_every_backend_finds_the_same_optimum(truth: gs.BeamParameters, span, backend: str) -> None:
    z, expected = draw(truth, 3000, 1, *span)
    reference = gs.fit_beam_parameters(z, expected, RANGE_MAX, backend="numpy")
    fit = gs.fit_beam_parameters(z, expected, RANGE_MAX, backend=backend)
    assert fit.precision == "float64" and fit.device.split(":")[0] == backend.split(":")[0]
    tolerance = TOLERANCES["learned parameters"]
    assert tolerance.difference(values(fit), values(reference)) <= tolerance.value
    assert tolerance.difference(errors(fit), errors(reference)) <= 1e3 * tolerance.value
    assert fit.log_likelihood == pytest.approx(reference.log_likelihood, rel=1e-12)


def test_float32_ends_within_a_hundredth_of_a_standard_error(needs) -> None:
    z, expected = draw(TYPICAL, 4000, 1)
    reference = gs.fit_beam_parameters(z, expected, RANGE_MAX, backend="numpy")
    fit = gs.fit_beam_parameters(z, expected, RANGE_MAX, backend=needs("opencl"), precision="float32")
    assert fit.precision == "float32" and fit.converged
    assert (np.abs(values(fit) - values(reference)) < 0.01 * errors(reference)).all()


@pytest.mark.long_on("warp")
def test_the_log_likelihood_is_the_sum_of_the_mixture(backend: str) -> None:
    z, expected = draw(TYPICAL, 2000, 2)
    fit = gs.fit_beam_parameters(z, expected, RANGE_MAX, backend=backend, responsibilities=True)
    log_p = log_mixture(np.minimum(z, RANGE_MAX), expected, range_max=RANGE_MAX, **fit.parameters.to_dict())
    assert fit.log_likelihood == pytest.approx(log_p.sum(), rel=1e-12)
    assert fit.trace[-1] == pytest.approx(fit.log_likelihood, rel=1e-14)
    parts = fit.responsibilities
    assert parts is not None and parts.shape == (2000, 4)
    np.testing.assert_allclose(parts.sum(axis=1), 1, rtol=1e-13)
    # At an optimum the mean responsibilities are the weights (book table 6.2, lines 10 to 13).
    np.testing.assert_allclose(parts.mean(axis=0), values(fit)[:4], atol=1e-6)
    assert fit.outliers == np.count_nonzero(parts.argmax(axis=1) == 3)
    assert (parts[np.isinf(z)] == [0, 0, 1, 0]).all()


def test_a_fit_of_the_model_scores_highest(needs) -> None:
    """BeamModel scores the fitted parameters higher than any nearby ones."""
    grid = gs.OccupancyGrid(np.pad(np.zeros((80, 120), np.int8), 1, constant_values=100), 0.1)
    scanner = gs.Scanner(np.linspace(-np.pi, np.pi, 1500, endpoint=False), 9.0)
    pose = [[4.0, 3.0, 0.3]]
    model = gs.BeamModel(grid, scanner, backend="numpy", precision="float64")
    expected = model.expected_ranges(pose)[0]
    from gpusense.evaluation.worlds import sample_readings

    z = sample_readings(np.minimum(expected, 9.0), 9.0, TYPICAL, np.random.default_rng(0))
    fit = gs.fit_beam_parameters(z, expected, 9.0, backend="numpy")

    def score(parameters: gs.BeamParameters) -> float:
        model = gs.BeamModel(grid, scanner, parameters, backend="numpy", precision="float64")
        return float(model.log_likelihood(pose, z)[0])

    assert score(fit.parameters) == pytest.approx(fit.log_likelihood, rel=1e-11)
    p = fit.parameters
    for near in (
        p.replace(sigma_hit=1.03 * p.sigma_hit),
        p.replace(sigma_hit=0.97 * p.sigma_hit),
        p.replace(lambda_short=1.1 * p.lambda_short),
        p.replace(lambda_short=0.9 * p.lambda_short),
        p.replace(z_hit=p.z_hit - 0.01, z_rand=p.z_rand + 0.01),
        p.replace(z_short=p.z_short - 0.01, z_max=p.z_max + 0.01),
    ):
        assert score(near) < fit.log_likelihood


@pytest.mark.long
@pytest.mark.sampled(0.3)
@pytest.mark.parametrize(("method", "scenes"), [("em", (15, 38)), ("gradient", (23,)), ("hill_climb", (31,))])
def test_other_methods_reach_the_optimum_from_six_starts(method: str, scenes: tuple[int, ...], needs) -> None:
    backend = needs("opencl")
    for number in scenes:
        scene = learning_scenes(50)[number]
        z, expected = scene.draw(800, np.random.default_rng(100 + number))
        best = gs.fit_beam_parameters(z, expected, scene.range_max, backend=backend)
        assert number in (23, 38) or identified(best).all(), scene.name
        for start in starts(z, expected, scene.range_max, 6):
            fit = gs.fit_beam_parameters(z, expected, scene.range_max, method=method, initial=start, backend=backend)
            assert fit.converged, (scene.name, fit.status)
            assert abs(fit.log_likelihood - best.log_likelihood) < 1e-6, (scene.name, start)
            assert (np.abs(values(fit) - values(best)) < 1e-3 * errors(best)).all(), (scene.name, start)


@pytest.mark.long
def test_hill_climbing_leaves_a_ridge_that_no_coordinate_climbs(needs) -> None:
    backend = needs("opencl")
    scene = learning_scenes(50)[21]
    z, expected = scene.draw(2000, np.random.default_rng(21))
    start = gs.BeamParameters(0.214, 0.107, 0.554, 0.125, scene.range_max, 0.131)
    best = gs.fit_beam_parameters(z, expected, scene.range_max, backend=backend)
    fit = gs.fit_beam_parameters(z, expected, scene.range_max, method="hill_climb", initial=start, backend=backend)
    assert fit.converged and abs(fit.log_likelihood - best.log_likelihood) < 1e-6
    # A truncated fit does not claim convergence.
    fit = gs.fit_beam_parameters(
        z, expected, scene.range_max, method="hill_climb", initial=start, max_iterations=8, backend=backend
    )
    assert fit.log_likelihood < best.log_likelihood - 100
    assert not fit.converged and "no convergence within 8 iterations" in fit.status


# Expected ranges near range_max truncate a wide p_hit; near ones truncate p_short.
@pytest.mark.parametrize(
    ("truth", "span", "name"),
    [(FAR, (0.8, 1.0), "sigma_hit"), (gs.BeamParameters(0.6, 0.2, 0.1, 0.1, 0.3, 0.3), (0.02, 0.2), "lambda_short")],
    ids=["far", "short ranges"],
)
def test_the_books_m_step_falls_where_components_are_cut_off(truth: gs.BeamParameters, span, name: str) -> None:
    z, expected = draw(truth, 4000, 1, *span)
    book = gs.fit_beam_parameters(z, expected, RANGE_MAX, method="em-book", initial=EQUAL, backend="numpy")
    exact = gs.fit_beam_parameters(z, expected, RANGE_MAX, initial=EQUAL, backend="numpy")
    falls = np.count_nonzero(np.diff(book.trace) < -1e-6)
    assert falls >= 10
    assert (
        f"the log-likelihood fell in {np.count_nonzero(np.diff(book.trace) < -1e-9)}" in book.status
        or "fell in" in book.status
    )
    assert worst_fall(exact) <= TOLERANCES["exact EM falls"].value
    assert exact.log_likelihood > book.log_likelihood + 10
    true = getattr(truth, name)
    wrong = abs(getattr(book.parameters, name) - true)
    assert wrong > 3 * abs(getattr(exact.parameters, name) - true)
    assert wrong > 5 * book.standard_errors[name]


def test_the_book_is_right_where_nothing_is_cut_off() -> None:
    """Far from both ends, with steep short readings, both M-steps are equal."""
    z, expected = draw(gs.BeamParameters(0.6, 0.2, 0.1, 0.1, 0.05, 10.0), 2000, 1, 0.5, 0.7)
    book = gs.fit_beam_parameters(
        z, expected, RANGE_MAX, method="em-book", backend="numpy", max_iterations=500, tolerance=1e-11
    )
    exact = gs.fit_beam_parameters(z, expected, RANGE_MAX, backend="numpy")
    assert book.converged and "fell" not in book.status
    np.testing.assert_allclose(values(book), values(exact), rtol=1e-4)


def test_an_offset_of_correct_ranges(backend: str) -> None:
    z, expected = draw(TYPICAL, 4000, 8)
    z = np.where(np.abs(z - expected) < 0.6, z + 0.05, z)
    plain = gs.fit_beam_parameters(z, expected, RANGE_MAX, backend=backend)
    fit = gs.fit_beam_parameters(z, expected, RANGE_MAX, backend=backend, range_bias=True)
    assert fit.bias_fitted and not plain.bias_fitted
    assert abs(fit.range_bias - 0.05) < 4 * fit.range_bias_error < 0.03
    assert fit.log_likelihood > plain.log_likelihood + 50
    assert fit.parameters.sigma_hit < plain.parameters.sigma_hit
    # To first order, the plain fit reports the offset.
    assert abs(plain.range_bias - fit.range_bias) < 0.02
    assert worst_fall(fit) <= TOLERANCES["exact EM falls"].value
    # Readings without the offset give the same fit.
    moved = gs.fit_beam_parameters(z - fit.range_bias, expected, RANGE_MAX + 1, backend=backend)
    assert moved.parameters.sigma_hit == pytest.approx(fit.parameters.sigma_hit, rel=0.02)


def test_readings_are_classed_and_counted() -> None:
    z, expected = draw(TYPICAL, 1000, 9)
    bad = np.array([np.nan, -np.inf, -1.0, 0.05])
    with_bad = np.concatenate([z, bad, [RANGE_MAX, RANGE_MAX + 1]])
    ahead = np.concatenate([expected, [np.nan, -3.0, np.inf, 4.0], [5.0, 5.0]])
    kept = z >= 0.1
    fit = gs.fit_beam_parameters(
        with_bad.reshape(2, -1), ahead.reshape(2, -1), RANGE_MAX, range_min=0.1, backend="numpy"
    )
    plain = gs.fit_beam_parameters(
        np.concatenate([z[kept], [np.inf, np.inf]]),
        np.concatenate([expected[kept], [1.0, 2.0]]),
        RANGE_MAX,
        backend="numpy",
    )
    assert (fit.hits, fit.max_readings, fit.missing) == (
        np.count_nonzero(kept & np.isfinite(z)),
        np.count_nonzero(np.isinf(z)) + 2,
        4 + np.count_nonzero(~kept),
    )
    np.testing.assert_allclose(values(fit), values(plain), rtol=1e-7)


def test_restarts_never_end_lower_and_repeat() -> None:
    z, expected = draw(TYPICAL, 300, 11)
    one = gs.fit_beam_parameters(z, expected, RANGE_MAX, backend="numpy")
    more = gs.fit_beam_parameters(z, expected, RANGE_MAX, backend="numpy", restarts=3, seed=1)
    again = gs.fit_beam_parameters(z, expected, RANGE_MAX, backend="numpy", restarts=3, seed=1)
    assert more.log_likelihood >= one.log_likelihood - 1e-8
    assert (values(more) == values(again)).all()


def test_results_report_their_history(capsys: pytest.CaptureFixture[str]) -> None:
    import json

    z, expected = draw(TYPICAL, 400, 12)
    seen: list[tuple[int, float, gs.BeamParameters]] = []
    fit = gs.fit_beam_parameters(
        z, expected, RANGE_MAX, backend="numpy", progress=True, callback=lambda *step: seen.append(step)
    )
    assert [step[0] for step in seen] == list(range(1, fit.iterations + 1)) and len(fit.trace) == fit.iterations + 1
    assert [step[1] for step in seen] == list(fit.trace[1:])
    assert seen[-1][2] == fit.parameters
    report = json.loads(json.dumps(fit.to_dict(), allow_nan=False))
    assert gs.BeamParameters.from_dict(report["parameters"]) == fit.parameters
    text = str(fit)
    for name in fit.parameters.to_dict():
        assert name in text
    assert "converged" in text and "float64 on numpy" in text
    # No terminal, no bar.
    assert capsys.readouterr() == ("", "")
    stopped = gs.fit_beam_parameters(z, expected, RANGE_MAX, initial=EQUAL, backend="numpy", max_iterations=2)
    assert not stopped.converged and "no convergence within 2 iterations" in stopped.status
    assert math.isfinite(stopped.log_likelihood)
