"""``protection_level``: quantiles of normal positions against mpmath and samples, clouds of filters, and limits."""

from __future__ import annotations

import math
import pickle
from types import SimpleNamespace

import mpmath
import numpy as np
import pytest
from support.tracking_scene import scan_at

import gpusense as gs

ROOM = gs.OccupancyGrid(np.pad(np.zeros((60, 80), int), 1, constant_values=100), 0.1)


def estimate(covariance, p_lost=0.0, size=500.0):
    return gs.Estimate(np.zeros(3), np.array(covariance), size, p_lost, "tracking", 0.9, 0.1, 1.0, False, 500)


def turned(large, small, angle):
    """Return a covariance with deviations along turned axes."""
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    covariance = np.diag([0.0, 0.0, 0.01])
    covariance[:2, :2] = turn @ np.diag([large**2, small**2]) @ turn.T
    return covariance


def beyond(large, small, radius):
    """Return the probability that a normal position is beyond a radius, by its density in polar coordinates."""
    a, b, r = (mpmath.mpf(float(value)) for value in (large, small, radius))

    def ring(angle):
        g = (mpmath.cos(angle) / a) ** 2 + (mpmath.sin(angle) / b) ** 2
        return mpmath.exp(-r * r * g / 2) / g

    return float(2 * mpmath.quad(ring, mpmath.linspace(0, mpmath.pi / 2, 9)) / (mpmath.pi * a * b))


@pytest.mark.parametrize("sigma", [1e-18, 0.03, 0.4, 1.0, 1e15])
@pytest.mark.parametrize("risk", [0.01, 0.05, 0.5])
def test_a_round_cloud_has_the_quantile_of_rayleigh(sigma: float, risk: float) -> None:
    covariance = np.diag([sigma**2, sigma**2, 0.01]).astype(np.float32).astype(np.float64)
    exact = math.sqrt(covariance[0, 0]) * math.sqrt(-2 * math.log(risk))
    assert estimate(covariance).protection_level(risk) == pytest.approx(exact, rel=1e-12)
    assert gs.PoseVerdict(0.0, "tracking", 0.9, covariance).protection_level(risk) == pytest.approx(exact, rel=1e-12)


@pytest.mark.parametrize("ratio", [0.9, 0.3, 0.05])
@pytest.mark.parametrize("p_lost", [0.0, 0.004, 0.0099])
def test_a_long_cloud_has_the_quantile_of_hoyt(ratio: float, p_lost: float) -> None:
    found = estimate(turned(0.2, 0.2 * ratio, 0.7), p_lost).protection_level(0.01)
    assert beyond(0.2, 0.2 * ratio, found) == pytest.approx((0.01 - p_lost) / (1 - p_lost), rel=1e-8)


def test_a_line_and_a_point_are_limits_of_clouds() -> None:
    line = estimate(turned(0.2, 0.0, 1.0)).protection_level(0.05)
    assert line == pytest.approx(0.2 * 1.959963984540054, rel=1e-9)
    assert estimate(np.zeros((3, 3))).protection_level(0.05) == 0


def test_samples_agree() -> None:
    covariance = turned(0.3, 0.1, -0.4)
    drawn = np.random.default_rng(0).multivariate_normal(np.zeros(2), covariance[:2, :2], 200_000)
    for risk in (0.01, 0.1, 0.6):
        share = np.mean(np.hypot(*drawn.T) > estimate(covariance).protection_level(risk))
        assert share == pytest.approx(risk, abs=4 * math.sqrt(risk / 200_000))


def test_the_probability_of_being_lost_takes_its_part_of_the_risk() -> None:
    covariance = np.diag([0.01, 0.01, 0.001])
    radii = [estimate(covariance, p_lost).protection_level(0.05) for p_lost in (0.0, 0.01, 0.04, 0.04999)]
    assert radii == sorted(radii) and math.isfinite(radii[-1])
    for p_lost in (0.05, 0.06, 1.0, math.nan):
        assert estimate(covariance, p_lost).protection_level(0.05) == math.inf
    assert estimate(covariance, 1.0).protection_level(1.0) == 0


def test_what_has_no_spread_promises_nothing() -> None:
    assert estimate(np.eye(3) * 0.01, size=1.0).protection_level(0.05) == math.inf
    for value in (math.inf, math.nan):
        assert estimate(np.diag([value, 0.1, 0.1])).protection_level(0.05) == math.inf
    # If the covariance is unknown, a pose that is not lost is off by at most 1 m.
    assert gs.PoseVerdict(0.01, "tracking", 0.9).protection_level(0.05) == 1.0
    assert gs.PoseVerdict(0.06, "tracking", 0.9).protection_level(0.05) == math.inf


@pytest.mark.parametrize("risk", [0, 0.0, -0.1, 0.009, 1.1, math.nan, math.inf, True, "0.05", None, [0.05]])
@pytest.mark.parametrize("judged", [estimate(np.eye(3)), gs.PoseVerdict(1.0, "lost", 0.1)], ids=["estimate", "verdict"])
def test_a_risk_that_no_data_support_is_refused(judged, risk) -> None:
    kind = ValueError if type(risk) in (int, float) else TypeError
    with pytest.raises(kind, match=r"^risk: must be"):
        judged.protection_level(risk)
    with pytest.raises(ValueError, match=r"^risk: must be at least 0.01, .* supports, got 0.0001$"):
        judged.protection_level(1e-4)


def at_poses(poses, backend="numpy"):
    """Return a filter without a map, with particles that are copies of poses."""
    pf = gs.ParticleFilter(gs.PositionModel(gs.PositionParameters(sigma=0.5), backend=backend), particles=len(poses))
    pf.initialize_from(SimpleNamespace(log_p=np.zeros(len(poses)), positions=poses))
    return pf


def test_a_cloud_of_a_filter_has_its_quantile(backend: str) -> None:
    """Nothing is widened unless a map is known: the cloud is the density of the start."""
    pf = gs.ParticleFilter(gs.PositionModel(gs.PositionParameters(), backend=backend), particles=4000)
    pf.initialize(mean=(5.0, 5.0, 0.0), covariance=np.diag([0.01, 0.01, 0.0001]))
    assert pf.estimate().protection_level(0.05) == pytest.approx(0.1 * math.sqrt(-2 * math.log(0.05)), rel=0.03)
    assert pf.estimate().widening == 1
    # Spread-out particles count by their distances: 3 % are 0.9 m off, all others coincide.
    poses = np.random.default_rng(0).normal((5.0, 5.0, 0.0), (0.01, 0.01, 0.12), (4000, 3))
    poses[:120, 0] += 0.9
    pf = at_poses(poses, backend)
    e = pf.estimate()
    far = np.quantile(np.hypot(*(pf.host_particles() - e.pose)[:, :2].T), 1 - (0.02 - e.p_lost) / (1 - e.p_lost))
    assert e.protection_level(0.02) == pytest.approx(far, rel=0.01) and far > 0.85


def test_an_estimate_keeps_the_particles_of_its_moment(backend: str) -> None:
    pf = at_poses(np.random.default_rng(0).normal((5.0, 5.0, 0.0), (0.3, 0.1, 0.12), (500, 3)), backend)
    kept = []
    for step in range(5):
        e = pf.estimate()
        kept.append((e, np.hypot(*(pf.host_particles() - e.pose)[:, :2].T)))
        pf.predict((0, 0, 0), (1.0, 0.1 * step, 0.3))
        pf.correct(np.array([6.0 + step, 5.0]))
    for e, distances in [*kept, (pickle.loads(pickle.dumps(kept[0][0])), kept[0][1])]:
        assert np.array_equal(e.distances._sorted[0], np.sort(distances))


def test_a_cluster_and_the_best_particle_count_all_particles() -> None:
    poses = np.random.default_rng(0).normal((5.0, 5.0, 0.0), (0.01, 0.01, 0.01), (1000, 3))
    poses[-30:, 0] += 3.0
    pf = at_poses(poses)
    far = (pf.host_particles()[:, 0] > 7).mean()
    assert 0.02 < far < 0.04
    for method in ("cluster", "best"):
        found = pf.estimate(method)
        assert found.p_lost == pytest.approx(far) and found.protection_level(0.01) == math.inf


def test_estimates_by_scans_are_widened(backend: str) -> None:
    scanner = gs.Scanner.uniform(angle_min=-3.1, angle_increment=0.2, count=32, range_max=12.0)
    model = gs.LikelihoodFieldModel(ROOM, scanner, backend=backend)
    ranges = scan_at((3.0, 2.0, 0.3), scanner, ROOM)
    pf = gs.ParticleFilter(model, particles=300)
    pf.initialize(mean=(3.0, 2.0, 0.3), covariance=np.diag([0.01, 0.01, 0.001]))
    assert pf.estimate().widening == 1
    pf.correct(ranges)
    e, monitor = pf.estimate(), gs.PoseMonitor(model)
    plain = gs.PoseVerdict(e.p_lost, e.verdict, e.explained, e.covariance).protection_level(0.5)
    assert e.widening > 1 and e.margin == 0.1
    assert e.protection_level(0.5) == pytest.approx(e.widening * plain + e.margin)
    v = monitor.update(e.pose, ranges, e.covariance)
    alone = gs.PoseVerdict(v.p_lost, v.verdict, v.explained, e.covariance).protection_level(0.5)
    assert v.protection_level(0.5) == pytest.approx(e.widening * alone + e.margin)


def test_the_scan_bounds_a_pose_without_a_covariance(backend: str) -> None:
    scanner = gs.Scanner.uniform(angle_min=-3.1, angle_increment=0.1, count=62, range_max=12.0)
    model = gs.LikelihoodFieldModel(ROOM, scanner, gs.LikelihoodFieldParameters(sigma_hit=0.1), backend=backend)
    pose = np.array([3.0, 2.0, 0.3])
    ranges = scan_at(pose, scanner, ROOM)

    def radius(place, readings, risk=0.3):
        found = gs.PoseMonitor(model).update(place, readings)
        return gs.PoseVerdict(0.0, "tracking", found.explained, distances=found.distances).protection_level(risk)

    # The exact radius, from a grid of all poses within the errors of a lost pose.
    x, y, turn = np.meshgrid(np.arange(-1, 1.01, 0.04), np.arange(-1, 1.01, 0.04), np.arange(-0.5, 0.501, 0.02))
    offsets = np.column_stack([x.ravel(), y.ravel(), turn.ravel()])
    offsets = offsets[np.hypot(x, y).ravel() <= 1]
    for off in (0.0, 0.3):
        place = pose + np.array([off, 0.0, 0.0])
        log_p = np.asarray(model.log_likelihood(place + offsets, ranges), np.float64) * 10 / 62
        weight, far = np.exp(log_p - log_p.max()), np.hypot(*offsets[:, :2].T)
        order = np.argsort(far)
        beyond = 1 - np.cumsum(weight[order]) / weight.sum()
        for risk in (0.05, 0.3):
            exact = far[order][np.argmax(beyond <= risk)]
            assert radius(place, ranges, risk) == pytest.approx(exact, abs=0.06)
    # A scan without a reading bounds nothing, so that a pose that is not lost may be off by up to 1 m.
    assert radius(pose, np.full(62, np.nan), 0.01) > 0.98
    promised = gs.PoseMonitor(model).update(pose, np.full(62, np.nan)).protection_level(0.5)
    assert 0.7 < promised <= 1.0
