"""Positions from beacons: truth is recovered, covariances are right, and the lowest minimum is found."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.optimize import least_squares
from support.position_scenes import CASES, POSE, XY

import gpusense as gs
from gpusense.positions.problem import LOSSES

each_case = pytest.mark.parametrize("case", CASES, ids=[case.name for case in CASES])
# Noiseless least squares ends at residuals of rounding, 1e-15 m, times the condition numbers: below 100 for XY, and
# below 1e7 for the worst random scene.
NEAR = dict(rtol=0, atol=1e-9)
FOUND = 1e-7


def turned(angle):
    """Return a rotation matrix."""
    return np.array([(math.cos(angle), -math.sin(angle)), (math.sin(angle), math.cos(angle))])


def near_truth(fix, truth):
    """Return a fix's solution nearest to the truth (two circles have two solutions)."""
    return fix.solutions[np.argmin(np.hypot(*(fix.solutions[:, :2] - truth[:2]).T))]


def apart(found, truth):
    """Return the difference of two solutions, of headings within +-pi."""
    difference = np.asarray(found) - truth[: len(found)]
    difference[2:] = np.remainder(difference[2:] + np.pi, 2 * np.pi) - np.pi
    return difference


@each_case
def test_truth_is_found(case):
    rng = np.random.default_rng(5)
    for _ in range(20):
        xy, pose = rng.uniform(-20, 20, (case.beacons, 2)), np.append(rng.uniform(-20, 20, 2), rng.uniform(-9, 9))
        fix = case.solve(xy, case.measure(xy, pose), pose[2], sigma=case.sigmas(case.beacons))
        found = near_truth(fix, pose)
        np.testing.assert_allclose(apart(found, pose), 0, rtol=0, atol=FOUND)
        assert fix.solutions.shape[1] == (3 if case.kind != "ranges" and not case.heading else 2)
        assert (np.diff(fix.cost) >= 0).all() or fix.status in ("two", "mirror")
        residuals = fix.residuals[np.argmin(np.hypot(*(fix.solutions[:, :2] - pose[:2]).T))]
        np.testing.assert_allclose(residuals, 0, rtol=0, atol=FOUND)


@each_case
def test_covariance_is_that_of_the_derivatives(case):
    """It is G S G^T with derivatives G of the complete solution by central differences, also for unequal weights."""
    xy, clean = XY[: case.beacons], case.measure(XY[: case.beacons], POSE)
    sigma = case.sigmas(case.beacons)
    options = {} if case.kind == "triangle" else {"weights": 0.5 + np.arange(case.beacons)}
    fix = case.solve(xy, clean, POSE[2], sigma=sigma, **options)
    step, columns = 1e-5, []
    for k in range(clean.size):
        ends = []
        for sign in (1, -1):
            values = clean.copy()
            values[k] += sign * step
            ends.append(near_truth(case.solve(xy, values, POSE[2], sigma=sigma, **options), POSE))
        columns.append(apart(ends[0], ends[1]) / (2 * step))
    gain = np.stack(columns, axis=1) * sigma
    found = fix.covariance[np.argmin(np.hypot(*(fix.solutions[:, :2] - POSE[:2]).T))]
    np.testing.assert_allclose(found, gain @ gain.T, rtol=1e-5, atol=1e-7 * np.abs(found).max())


@pytest.mark.sampled(0.5)
@each_case
def test_ellipses_hold_the_truth_as_often_as_they_say(case):
    """The number of truths in 95 % ellipses of noisy fixes is within 4 sigma of the binomial distribution."""
    rng = np.random.default_rng(6)
    xy, clean = XY[: case.beacons], case.measure(XY[: case.beacons], POSE)
    sigma, runs = case.sigmas(case.beacons), 150
    inside = 0
    for _ in range(runs):
        fix = case.solve(xy, clean + sigma * rng.standard_normal(clean.size), POSE[2], sigma=sigma)
        nearest = np.argmin(np.hypot(*(fix.solutions[:, :2] - POSE[:2]).T))
        error = apart(fix.solutions[nearest], POSE)
        # The 95 % quantiles of chi-squared with 2 and 3 degrees of freedom.
        inside += error @ np.linalg.solve(fix.covariance[nearest], error) < {2: 5.991465, 3: 7.814728}[error.size]
    assert abs(inside - 0.95 * runs) < 4 * math.sqrt(runs * 0.95 * 0.05)


@each_case
def test_turn_shift_scale_and_order(case):
    """The solution follows a scene that is turned, shifted, scaled or reordered."""
    rng = np.random.default_rng(7)
    xy, sigma = XY[: case.beacons], case.sigmas(case.beacons)
    noise = sigma * rng.standard_normal(sigma.size)
    values = case.measure(xy, POSE) + noise
    base = case.solve(xy, values, POSE[2], sigma=sigma)
    lengths = case.kind in ("ranges", "both")
    for angle, shift, scale in ((0.7, (0, 0), 1.0), (-2.5, (5e6, -3e5), 1.0), (1.0, (3.0, 4.0), 256.0)):
        order = rng.permutation(case.beacons)
        stretch = np.where(np.arange(values.size) < case.beacons, scale if lengths else 1.0, 1.0)
        moved = (scale * xy @ turned(angle).T + shift)[order]
        both = np.concatenate([order, order + case.beacons])[: values.size]
        fix = case.solve(moved, (values * stretch)[both], POSE[2] + angle, sigma=(sigma * stretch)[both])
        assert (fix.status, fix.degenerate, len(fix)) == (base.status, base.degenerate, len(base))
        # Rounding flattens the cost of noisy measurements within its root, about 1.5e-8 sigma; coordinates of 5e6 m
        # are rounded to 1e-9 m.
        precision = 1e-7 * scale + 1e-7 * (np.abs(shift).max() > 1e3)
        frame = np.eye(fix.solutions.shape[1])
        frame[:2, :2] = scale * turned(angle)
        expected = base.solutions @ frame.T
        expected[:, :2] += shift
        expected[:, 2:] += angle
        for row, covariance in zip(expected, base.covariance, strict=True):
            match = np.argmin(np.hypot(*(fix.solutions[:, :2] - row[:2]).T))
            np.testing.assert_allclose(apart(fix.solutions[match], row), 0, rtol=0, atol=precision)
            wanted = frame @ covariance @ frame.T
            np.testing.assert_allclose(fix.covariance[match], wanted, rtol=1e-5, atol=1e-6 * np.abs(wanted).max())
        np.testing.assert_allclose(fix.cost, base.cost, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("case", [c for c in CASES if c.kind != "ranges"], ids=lambda case: case.name)
def test_whole_turns_change_nothing(case):
    """Bearings and headings of any size are valid; for a robot that looks along -x they are on both sides of pi."""
    xy = XY[: case.beacons] - (20.0, 0.0)
    pose = np.array([2.5, 0.5, 0.01])
    values = case.measure(xy, pose)
    sigma = case.sigmas(case.beacons)
    base = case.solve(xy, values, pose[2], sigma=sigma)
    np.testing.assert_allclose(apart(base.best, pose), 0, **NEAR)
    turns = 2 * np.pi * np.array([3, -2, 0, 1000, -1])[: case.beacons]
    values[-case.beacons :] += turns
    fix = case.solve(xy, values, pose[2] - 4 * np.pi, sigma=sigma)
    np.testing.assert_allclose(apart(fix.best, pose), 0, **NEAR)
    if base.solutions.shape[1] == 3:
        assert abs(fix.best[2]) <= np.pi


def lowest(case, xy, values, sigma, theta, loss, scale, centre):
    """Return the lowest cost that SciPy finds from starts all over the scene, an oracle without closed forms."""
    half = xy.shape[0]

    def residuals(state):
        dx, dy = (xy - state[:2]).T
        heading = theta if case.heading else (state[2] if len(state) > 2 else 0.0)
        r, b = np.hypot(dx, dy), np.arctan2(dy, dx) - heading
        expected = {"ranges": r, "bearings": b}.get(case.kind, np.append(r, b))
        found = values - expected
        if case.kind != "ranges":
            found[-half:] = np.arctan2(np.sin(found[-half:]), np.cos(found[-half:]))
        return found / sigma

    best = math.inf
    places = np.stack(np.meshgrid(*[np.linspace(-9, 9, 5)] * 2), axis=-1).reshape(-1, 2) + centre
    headings = np.linspace(-np.pi, np.pi, 4, endpoint=False) if case.kind != "ranges" and not case.heading else [None]
    for place in places:
        for heading in headings:
            start = place if heading is None else np.append(place, heading)
            found = least_squares(residuals, start, loss=loss, f_scale=scale, max_nfev=60)
            best = min(best, 2 * found.cost)
    return best


@pytest.mark.sampled(0.5)
@pytest.mark.parametrize("name", ["five ranges", "four rays", "five bearings", "four of both"])
@pytest.mark.parametrize("loss", ["linear", "cauchy"])
def test_the_global_minimum_is_found(name, loss):
    """Despite coarse noise and a gross outlier, no start of a lattice leads to a lower cost."""
    case = next(case for case in CASES if case.name == name)
    rng = np.random.default_rng(8)
    for _ in range(2):
        xy, pose = rng.uniform(-8, 8, (case.beacons, 2)), np.append(rng.uniform(-6, 6, 2), rng.uniform(-3, 3))
        sigma = 5 * case.sigmas(case.beacons)
        values = case.measure(xy, pose) + sigma * rng.standard_normal(case.sigmas(case.beacons).size)
        values[1] += 40 * sigma[1]
        fix = case.solve(xy, values, pose[2], sigma=sigma, loss=loss, loss_scale=2.0)
        oracle = lowest(case, xy, values, sigma, pose[2], loss, 2.0, xy.mean(axis=0))
        assert fix.cost[0] <= oracle * (1 + 1e-9) + 1e-9


@pytest.mark.parametrize("name", ["five ranges", "five bearings", "four of both", "four rays"])
@pytest.mark.parametrize("loss", sorted(set(LOSSES) - {"linear"}))
def test_robust_losses_forget_an_outlier(name, loss):
    case = next(case for case in CASES if case.name == name)
    xy, sigma = np.vstack([XY, XY[:3] * 1.5 + 1.0]), case.sigmas(8)
    values = case.measure(xy, POSE)
    values[3] += 100 * sigma[3]
    options = dict(sigma=sigma, loss=loss, loss_scale=0.1)
    error = np.abs(apart(case.solve(xy, values, POSE[2], **options).best, POSE)[:2]).max()
    plain = np.abs(apart(case.solve(xy, values, POSE[2], sigma=sigma).best, POSE)[:2]).max()
    assert error < 0.1 * plain
    # A weight of 0 ignores the beacon, and its residual is not reported.
    weights = np.where(np.arange(8) == 3, 0.0, 1.0)
    fix = case.solve(xy, values, POSE[2], sigma=sigma, weights=weights)
    np.testing.assert_allclose(apart(fix.best, POSE), 0, **NEAR)
    assert np.isnan(fix.residuals[0][3]).all() and np.isfinite(np.delete(fix.residuals[0], 3, axis=0)).all()


@pytest.mark.parametrize("loss", sorted(LOSSES))
def test_losses_are_those_of_scipy(loss):
    """The cost is twice SciPy's for the loss of the same name, and its slope is the cost's derivative."""
    z = np.array([0.0, 1e-9, 0.3, 0.999, 1.001, 7.0, 1e6])
    value, slope, curve = LOSSES[loss](z)
    for residual, mine in zip(np.sqrt(z), value, strict=True):
        theirs = least_squares(lambda x, r=residual: r + 0 * x, [0.0], loss=loss, max_nfev=1)
        assert 2 * theirs.cost == pytest.approx(mine, rel=1e-12, abs=1e-15)
    step = 1e-6 * np.maximum(z, 1e-3)
    ahead, behind = LOSSES[loss](z + step), LOSSES[loss](z - np.minimum(step, z))
    width = step + np.minimum(step, z)
    np.testing.assert_allclose((ahead[0] - behind[0]) / width, slope, rtol=2e-3)
    np.testing.assert_allclose((ahead[1] - behind[1]) / width, curve, rtol=2e-3, atol=1e-6)


def test_many_beacons():
    """Only some pairs and triples are tried; the result is independent of the choice."""
    rng = np.random.default_rng(9)
    xy = rng.uniform(-50, 50, (200, 2))
    for case in CASES:
        if case.beacons < 3 or case.kind == "triangle":
            continue
        clean = case.measure(xy, POSE)
        sigma = np.full(clean.size, 0.01)
        fix = case.solve(xy, clean + sigma * rng.standard_normal(clean.size), POSE[2], sigma=sigma)
        assert fix.status == "unique"
        error = apart(fix.best, POSE)
        assert error @ np.linalg.solve(fix.covariance[0], error) < 20
        # Chi-squared has about as many degrees of freedom as there are measurements.
        assert abs(fix.cost[0] / clean.size - 1) < 0.35


def test_results_cannot_be_changed():
    fix = gs.trilaterate(XY, np.hypot(*(XY - POSE[:2]).T))
    for array in (fix.solutions, fix.covariance, fix.residuals, fix.best):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0
    np.testing.assert_allclose(fix.deviation, np.sqrt(np.trace(fix.covariance[0])))
