"""Positions from beacons: truth is recovered, covariances are right, and the lowest minimum is found."""

from __future__ import annotations

import gzip
import itertools
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
    value, slope = LOSSES[loss](z)
    for residual, mine in zip(np.sqrt(z), value, strict=True):
        theirs = least_squares(lambda x, r=residual: r + 0 * x, [0.0], loss=loss, max_nfev=1)
        assert 2 * theirs.cost == pytest.approx(mine, rel=1e-12, abs=1e-15)
    step = 1e-6 * np.maximum(z, 1e-3)
    ahead, behind = LOSSES[loss](z + step), LOSSES[loss](z - np.minimum(step, z))
    width = step + np.minimum(step, z)
    np.testing.assert_allclose((ahead[0] - behind[0]) / width, slope, rtol=2e-3)


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


# Errors of single sightings against the reference pose, including errors of map and reference.
SIGMA_RANGE, SIGMA_BEARING = 0.06, 0.03


@pytest.fixture(scope="module")
def sightings(data_dir):
    """Return the moments at which two or more mapped beacons were seen: reference pose, beacons, ranges, bearings."""
    folder = data_dir / "beacons_enmt482"
    rows = np.genfromtxt(folder / "beacon_map.csv", delimiter=",", skip_header=1)
    places = {int(row[0]): row[1:3] for row in rows}
    with gzip.open(folder / "data.csv.gz", "rt") as stream:
        table = [line.rstrip("\n").split(",") for line in itertools.islice(stream, 1, None)]
    seen = [row for row in table if row[9] and int(float(row[9])) in places]
    moments = []
    for _, group in itertools.groupby(seen, key=lambda row: row[0]):
        rows = list(group)
        if len(rows) < 2:
            continue
        pose = np.array(rows[0][3:6], float)
        xy = np.array([places[int(float(row[9]))] for row in rows])
        local = np.array([row[10:12] for row in rows], float)
        moments.append((pose, xy, np.hypot(*local.T), np.arctan2(local[:, 1], local[:, 0])))
    return moments


def errors(fixes, truths):
    """Return the distance of the nearest solution of each fix from the truth [m]."""
    return np.array([np.hypot(*(f.solutions[:, :2] - t[:2]).T).min() for f, t in zip(fixes, truths, strict=True)])


def quantiles(values):
    """Return the median and the 90 % quantile."""
    return np.quantile(values, [0.5, 0.9])


def test_two_fiducials(sightings):
    """Fixes are as near the reference as single sightings: some cm, plus cm for 0.01 rad over a few metres.

    The bounds include the errors of map and reference: ranges of sightings are off by 5 cm in the median and 13 cm at
    90 %, their bearings by 0.008 and 0.03 rad.
    """
    truths = [pose for pose, *_ in sightings]
    assert len(truths) > 200
    deviations = {"sigma_range": SIGMA_RANGE, "sigma_bearing": SIGMA_BEARING}
    circles = [gs.trilaterate(xy, r, sigma=SIGMA_RANGE) for _, xy, r, _ in sightings]
    poses = [gs.locate(xy, r, b, **deviations) for _, xy, r, b in sightings]
    rays = [gs.triangulate(xy, b, pose[2], sigma=SIGMA_BEARING) for pose, xy, _, b in sightings]
    single = [gs.locate(xy[:1], r[:1], b[:1], pose[2], **deviations) for pose, xy, r, b in sightings]
    assert all(fix.status in ("two", "contained") for fix in circles)
    assert all(fix.status == "unique" for fix in [*poses, *rays, *single])
    for fixes, median, most in ((circles, 0.15, 0.4), (poses, 0.15, 0.3), (rays, 0.04, 0.12), (single, 0.08, 0.2)):
        found = quantiles(errors(fixes, truths))
        assert found[0] < median and found[1] < most, (found, median, most)
    turns = np.array([np.angle(np.exp(1j * (f.best[2] - t[2]))) for f, t in zip(poses, truths, strict=True)])
    assert quantiles(np.abs(turns))[0] < 0.08 and quantiles(np.abs(turns))[1] < 0.12
    # Errors fit the covariance: the median of chi-squared is 2.4 for three degrees of freedom.
    away = [f.best - t for f, t in zip(poses, truths, strict=True)]
    for error, turn in zip(away, turns, strict=True):
        error[2] = turn
    scaled = [e @ np.linalg.solve(f.covariance[0], e) for e, f in zip(away, poses, strict=True)]
    assert 1.0 < np.median(scaled) < 4.0
