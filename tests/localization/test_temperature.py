"""The temperature against the variance of scores, which follows from the distribution of drawn errors."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from scipy.signal import lfilter
from support.tracking_scene import FINE, GRID, TRUTH, scan_at

import gpusense as gs
from gpusense.localization import lessons
from gpusense.localization.temperature import BeamCorrelation, axes_of, poses_around

HALF = np.array([3.0, 2.0])
# For 40 scans with four blocks, F_4 has a standard deviation of 0.15, and F_4 / F_16 of 0.2, weighted up to three
# times, and only above 1.
LEAST, MOST = 0.5, 1.3


def room(headings, count, span=np.pi):
    """Return (K, 3) gradients of the distances of end points to walls of a room, seen from its centre, and bearings."""
    ways = np.linspace(-span / 2, span / 2, count, endpoint=False) + headings
    towards = np.stack([np.cos(ways), np.sin(ways)], axis=1)
    reach = HALF / np.maximum(np.abs(towards), 1e-9)
    first = reach[:, 0] < reach[:, 1]
    normal = np.sign(towards) * np.stack([first, ~first], axis=1)
    ends = towards * reach.min(axis=1)[:, None]
    return np.column_stack([normal, normal[:, 1] * ends[:, 0] - normal[:, 0] * ends[:, 1]]), ways


def autoregressive(rng, count, phi):
    """Return normal errors of variance 1 and autocorrelation phi^l."""
    noise = rng.normal(size=count + 200) * np.sqrt(1 - phi * phi)
    return lfilter([1.0], [1.0, -phi], noise)[200:]


def learned(draw, count, scans=150, sigma=0.05):
    """Return the learned temperature of scans with drawn errors, and the temperature for a mean NEES of 3."""
    rng, found, squared = np.random.default_rng(3), BeamCorrelation(), []
    for _ in range(scans):
        gradients, ways = room(rng.uniform(0, 2 * np.pi), count)
        errors = draw(rng, count) * sigma
        information = gradients.T @ gradients / sigma**2
        fit = np.linalg.solve(information, gradients.T @ errors / sigma**2)
        squared.append(fit @ information @ fit)
        axes = axes_of(np.linalg.inv(information))
        moved = errors - poses_around(fit, axes) @ gradients.T
        found.add(-0.5 * (moved / sigma) ** 2 - 1, axes, ways)
    return found, 3 / np.mean(squared)


@pytest.mark.parametrize(("count", "phi"), [(180, 0.0), (720, 0.0), (720, 0.4), (720, 0.7)])
def test_short_correlations_have_the_temperature_of_theory(count, phi):
    found, _ = learned(lambda rng, n: autoregressive(rng, n, phi), count)
    wanted = (1 - phi) / (1 + phi)
    assert LEAST * wanted < found.temperature(count) < MOST * wanted
    assert found.repeat < 0.2


@pytest.mark.parametrize(("count", "phi"), [(180, 0.8), (180, 0.95), (60, 0.8)])
def test_long_correlations_make_normalised_errors_of_fits_right(count, phi):
    found, wanted = learned(lambda rng, n: autoregressive(rng, n, phi), count)
    # Their variance stops growing at the scale of the whole scan, invisible to blocks: at most 3 times too careful.
    assert wanted / 3 < found.temperature(count) < 1.2 * wanted
    plain = learned(lambda rng, n: rng.normal(size=n), count)[0]
    assert found.temperature(count) < 0.5 * plain.temperature(count)


def test_errors_that_are_larger_than_the_models_lower_the_temperature_too():
    found, wanted = learned(lambda rng, n: 2 * rng.normal(size=n), 360)
    assert 0.25 * LEAST < found.temperature(360) < 0.25 * MOST and wanted == pytest.approx(0.25, rel=0.25)
    small, _ = learned(lambda rng, n: 0.5 * rng.normal(size=n), 360)
    assert small.temperature(360) == 1.0


@pytest.mark.parametrize("phi", [0.3, 0.8])
def test_errors_that_repeat_are_found_in_turned_scans(phi):
    """Errors belong to directions in the world, and change from scan to scan by a first-order autoregression."""
    rng, sigma, bins = np.random.default_rng(5), 0.05, 720
    found, apart = BeamCorrelation(), BeamCorrelation()
    field, heading = rng.normal(size=bins), 0.0
    for _ in range(120):
        field = phi * field + np.sqrt(1 - phi * phi) * rng.normal(size=bins)
        heading += 2 * np.pi / bins * rng.integers(-20, 20)
        gradients, ways = room(heading, 360)
        errors = sigma * field[np.rint(ways / (2 * np.pi) * bins).astype(int) % bins]
        # The filter knows the pose better than a scan.
        axes = axes_of(0.5 * np.linalg.inv(gradients.T @ gradients / sigma**2))
        moved = errors - poses_around(np.zeros(3), axes) @ gradients.T
        for one in (found, apart):
            one.add(-0.5 * (moved / sigma) ** 2 - 1, axes, ways, follows=one is found)
    assert found.repeat == pytest.approx(phi, abs=0.15) and apart.repeat == 0
    repeated = found.repeat * found.kept
    assert 0.4 < found.kept < 1
    wanted = apart.temperature(360) * (1 - repeated) / (1 + repeated)
    assert found.temperature(360) == pytest.approx(wanted, rel=0.25)


def test_scans_that_do_not_follow_and_few_beams_are_not_compared():
    found, rng = BeamCorrelation(), np.random.default_rng(0)
    gradients, ways = room(0.0, 60)
    axes = axes_of(np.linalg.inv(gradients.T @ gradients / 0.01))
    for index in range(20):
        moved = 0.1 * rng.normal(size=60) - poses_around(np.zeros(3), axes) @ gradients.T
        parts = -0.5 * (moved / 0.1) ** 2 - 1
        parts[:, 50:] = (0.0, -np.inf)[index % 2]
        found.add(parts, axes, ways, follows=False)
        found.add(parts[:, :7], axes, ways[:7])
    assert found.scans == 20 and found.beams == pytest.approx(50) and found.repeat == 0
    with pytest.raises(ValueError, match="parts: shape must be"):
        found.add(parts[0], axes)


def test_models_of_scans_are_calibrated():
    """Errors of beam models of a room are independent, or moving averages of 6 beams (inflation 6)."""
    scanner = gs.Scanner.uniform(angle_min=-np.pi, angle_increment=np.pi / 180, count=360, range_max=10.0)
    model = gs.BeamModel(GRID, scanner, gs.BeamParameters(0.97, 0.0, 0.0, 0.03, sigma_hit=0.05), backend="numpy")
    rng = np.random.default_rng(2)
    poses = np.column_stack([rng.uniform(3, 5, 30), rng.uniform(2.5, 4, 30), rng.uniform(-3, 3, 30)])
    exact = gs.RayCaster(GRID, range_max=10.0, backend="numpy").cast(poses, scanner.bearings)
    white = exact + 0.05 * rng.normal(size=exact.shape)
    smooth = exact + 0.05 * lfilter(np.full(6, 6**-0.5), [1.0], rng.normal(size=(30, 365)))[:, 5:]
    found = [gs.calibrate_temperature(model, scans, poses) for scans in (white, smooth)]
    assert found[0] > LEAST
    # Errors of ranges count by the cosine of the incidence; it differs between neighbours and reduces correlation.
    assert LEAST / 6 < found[1] < 1.6 / 6
    with pytest.raises(ValueError, match="scans: must be at least 5"):
        gs.calibrate_temperature(model, white[:4], poses[:4])
    missing = np.full_like(white, np.nan)
    missing[:4] = white[:4]
    with pytest.raises(ValueError, match="scans: at least 5 must have 8 beams that the model uses, got 4 of 30"):
        gs.calibrate_temperature(model, missing, poses)
    positions = gs.PositionModel(gs.PositionParameters(sigma=0.1), backend="numpy")
    with pytest.raises(TypeError, match=r"model: must be a model of scans, got .*PositionModel"):
        gs.calibrate_temperature(positions, white, poses)


def test_a_filter_learns_from_each_scanner_while_its_particles_lie_together():
    models = [gs.LikelihoodFieldModel(GRID, FINE, backend="numpy") for _ in range(2)]
    ranges = scan_at(TRUTH, FINE)
    pf = gs.ParticleFilter(models, particles=100, seed=1)
    pf.initialize(mean=TRUTH, covariance=np.diag([1e-3, 1e-3, 1e-4]))
    first = pf.temperatures
    for step in range(16):
        pf.correct({models[step % 2]: ranges})
        pf.predict((0, 0, 0), (0, 0, 0))
    assert first == (10 / 60, 10 / 60) and all(0 < value != 10 / 60 for value in pf.temperatures)
    # The next correction starts the lesson of a scan, and the one after it ends the lesson.
    known = pf.temperatures
    assert [sensor.learner.correlation.scans for sensor in pf._sensors] == [7, 7]
    copied = pickle.loads(pickle.dumps(pf))
    for one in (pf, copied):
        assert one.temperatures == known
        one.correct({one.models[0]: ranges})
        one.initialize_uniform()
        one.correct({one.models[0]: np.full(60, 20.0)})
        assert [sensor.learner.correlation.scans for sensor in one._sensors] == [8, 7]
        assert all(sensor.learner.correlation.repeat > 0.5 for sensor in one._sensors)
    assert pf.temperatures == copied.temperatures
    assert np.array_equal(*(one._sensors[1].learner.correlation._means for one in (pf, copied)))


def test_a_correction_after_the_first_scans_does_one_part_of_a_lesson(monkeypatch):
    parts = []
    ranges = scan_at(TRUTH, FINE)
    advance = lessons.Learner._advanced
    monkeypatch.setattr(lessons.Learner, "_advanced", lambda my, one: (parts.append(one.stage), advance(my, one))[1])
    pf = gs.ParticleFilter(gs.LikelihoodFieldModel(GRID, FINE, backend="numpy"), particles=100, seed=1)
    pf.initialize(mean=TRUTH, covariance=np.diag([1e-3, 1e-3, 1e-4]))
    done = []
    for _ in range(100):
        parts.clear()
        pf.correct(ranges)
        pf.predict((0, 0, 0), (0, 0, 0))
        done.append([*parts])
    order = list(range(3, 11))
    assert done[40] == order and max(map(len, done[62:])) == 1
    # Scans 75, 76 and 100 are lessons, whose poses are placed first.
    assert [name for step in done[74:] for name in step] == [0, 0, *order, *order]


@pytest.mark.parametrize("scans", [5, 20])
def test_independent_beams_are_not_taken_for_correlated_ones(scans):
    inflations, count = [], 180
    for seed in range(30):
        rng, correlation = np.random.default_rng(seed), BeamCorrelation()
        for _ in range(scans):
            poses = poses_around(np.zeros(3), np.eye(3))
            gradients, errors = 0.02 * rng.normal(size=(count, 3)), rng.normal(size=count)
            correlation.add(-0.5 * (errors - poses @ gradients.T) ** 2, np.eye(3))
        inflations.append(correlation.inflation)
    assert np.mean(inflations) < 1.05


def test_correlated_beams_of_a_few_scans_are_seen():
    rng, correlation = np.random.default_rng(0), BeamCorrelation()
    for _ in range(5):
        gradients = np.repeat(0.02 * rng.normal(size=(4, 3)), 45, axis=0)
        errors = autoregressive(rng, 180, 0.95)
        correlation.add(-0.5 * (errors - poses_around(np.zeros(3), np.eye(3)) @ gradients.T) ** 2, np.eye(3))
    assert correlation.inflation > 5
