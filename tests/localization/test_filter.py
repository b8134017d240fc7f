"""The particle filter against a Kalman filter, itself, and bad input; the models of motion and the algebra of poses."""

from __future__ import annotations

import numpy as np
import pytest
from support.tracking_scene import FINE, GRID, TRUTH, driven, scan_at

import gpusense as gs
from gpusense.interface.constants import SHARE
from gpusense.localization.defaults import DEFAULTS
from gpusense.localization.estimates import clustered
from gpusense.localization.motion import STILL
from gpusense.localization.tracker import kld_count


def gps(backend="numpy", precision="float64"):
    parameters = gs.PositionParameters(sigma=0.3, z_rand=0.0)
    return gs.PositionModel(parameters, backend=backend, precision=precision)


def posterior(count, seed, backend="numpy"):
    """Return mean and covariance of a robot with a known heading, after three steps and fixes."""
    motion = gs.OdometryMotion((0, 0, 0.04, 0), reverse=0.0, least=(0.0, 0.0))
    pf = gs.ParticleFilter(gps(backend), motion=motion, particles=count, seed=seed, stages=1)
    pf.initialize(mean=(0, 0, 0), covariance=np.diag([0.5, 0.5, 0.0]))
    for step, fix in enumerate(((1.3, 0.2), (2.1, -0.3), (3.4, 0.1))):
        pf.predict((step, 0, 0), (step + 1, 0, 0))
        pf.correct(np.array(fix))
    return pf.estimate()


def kalman():
    mean, variance = np.zeros(2), np.array([0.5, 0.5])
    for fix in ((1.3, 0.2), (2.1, -0.3), (3.4, 0.1)):
        mean, variance = mean + np.array([1, 0]), variance + np.array([0.04, 0])
        gain = variance / (variance + 0.09)
        mean, variance = mean + gain * (fix - mean), (1 - gain) * variance
    return mean, variance


@pytest.mark.long_on("warp")
def test_a_linear_gaussian_problem_has_the_kalman_filters_answer(backend):
    found, (mean, variance) = posterior(4000, 3, backend), kalman()
    # Three draws leave the mean of some 1000 independent particles: 4 deviations of it.
    np.testing.assert_allclose(found.pose[:2], mean, atol=4 * np.sqrt(variance.max() / 1000))
    np.testing.assert_allclose(np.diag(found.covariance)[:2], variance, rtol=0.15)
    assert abs(found.pose[2]) < 1e-12


@pytest.mark.long_on("warp")
def test_many_particles_take_no_more_stages_than_they_need(backend):
    # For a ratio r of the variances of fix and prior, r (2 + r) / (1 + r)^2 = 7.5 % of the particles are effective.
    def state(count, deviation):
        sigma = deviation * np.sqrt(0.04)
        model = gs.PositionModel(gs.PositionParameters(sigma=sigma, z_rand=0.0), backend=backend)
        pf = gs.ParticleFilter(model, particles=count, seed=1)
        pf.initialize(mean=(0, 0, 0), covariance=np.diag([deviation**2, deviation**2, 0.01]))
        pf.correct(np.zeros(2))
        return pf._cloud.summary()

    few, many, apart = state(4000, 0.5), state(20_000, 0.5), state(20_000, 2.0)
    assert few.stages > 1 and many.stages == 1 and apart.stages > 1
    assert 500 < many.effective_sample_size < 0.1 * 20_000


def test_landmarks_that_may_be_exchanged_keep_more_particles():
    model = gs.LandmarkModel(gs.LandmarkMap([[2.0, 2.0], [2.0, 2.6]]), backend="numpy")
    shares = []
    for models in (model, gps()):
        pf = gs.ParticleFilter(models, particles=1000, seed=1)
        pf.initialize(mean=(0, 0, 0), covariance=np.diag([0.1, 0.1, 0.01]))
        shares.append(pf._parts.tracker.settings(STILL, [0])[SHARE])
    assert shares == [DEFAULTS.share_apart, DEFAULTS.share]


def on_host(array):
    """Return a NumPy array, or one of pyopencl or Warp, as NumPy's."""
    return array.get() if hasattr(array, "get") else array.numpy() if hasattr(array, "numpy") else array


def tracked(backend, count=400, **options):
    model = gs.LikelihoodFieldModel(GRID, FINE, gs.LikelihoodFieldParameters(sigma_hit=0.1), backend=backend)
    pf = gs.ParticleFilter(model, particles=count, **{"seed": 5} | options)
    pf.initialize(mean=TRUTH + np.array([0.2, -0.2, 0.1]), covariance=np.diag([0.1, 0.1, 0.03]))
    return pf, driven(pf, 8, FINE)


@pytest.mark.long_on("warp")
@pytest.mark.parametrize(
    "options",
    [{}, dict(stages=1), dict(resampling="stratified"), dict(resampling="residual"), dict(particles=(200, 600))],
)
@pytest.mark.sampled(1.0)
def test_a_robot_in_a_room_is_tracked(backend, options):
    pf, pose = tracked(backend, options.pop("particles", 400), **options)
    for method in ("mean", "cluster"):
        found = pf.estimate(method)
        assert np.hypot(*(found.pose - pose)[:2]) < 0.1 and abs(found.pose[2] - pose[2]) < 0.05
        assert not found.lost and found.explained > 0.9
    assert np.hypot(*(pf.estimate("best").pose - pose)[:2]) < 0.3
    weights = pf.host_weights()
    assert abs(weights.sum() - 1) < 1e-12 and pf.particles.shape == (len(weights), 3) == (*pf.weights.shape, 3)
    assert np.array_equal(on_host(pf.particles), pf.host_particles())
    np.testing.assert_allclose(on_host(pf.weights), weights, rtol=1e-14, atol=0)


@pytest.mark.long_on("warp")
def test_the_same_seed_gives_the_same_bits_and_another_one_others(backend):
    one, two = tracked(backend)[0], tracked(backend)[0]
    assert np.array_equal(one.host_particles(), two.host_particles())
    assert np.array_equal(one.host_weights(), two.host_weights())
    # Random numbers are common to all backends: estimates differ less than for two seeds.
    reference, other = (tracked("numpy", seed=seed)[0] for seed in (5, 6))
    assert np.abs(one.estimate().pose - reference.estimate().pose).max() < 0.03
    assert not np.array_equal(other.host_particles(), reference.host_particles())


@pytest.mark.long_on("warp")
def test_several_sensors_weigh_together(backend):
    fields = gs.LikelihoodFieldModel(GRID, FINE, backend=backend)
    compass = gs.HeadingModel(gs.HeadingParameters(sigma=0.02), backend=backend)
    pf = gs.ParticleFilter([fields, compass], particles=500, seed=1)
    # A rectangle looks the same from the other side: the compass decides.
    pf.initialize_uniform()
    for _ in range(6):
        pf.correct({fields: scan_at(TRUTH, FINE), compass: float(TRUTH[2])})
        pf.predict((0, 0, 0), (0, 0, 0))
    assert abs(pf.estimate("cluster").pose[2] - TRUTH[2]) < 0.05
    pf.correct({fields: None, compass: float(TRUTH[2])})
    with pytest.raises(KeyError, match="must be of the filter's models"):
        pf.correct({gps(backend): np.zeros(2)})
    with pytest.raises(TypeError, match="must be a mapping"):
        pf.correct(scan_at(TRUTH, FINE))


def test_impossible_readings_change_nothing():
    parameters = gs.LikelihoodFieldParameters(z_hit=1.0, z_rand=0.0, z_max=0.0, sigma_hit=0.01)
    model = gs.BeamModel(GRID, FINE, gs.BeamParameters(1.0, 0.0, 0.0, 0.0, sigma_hit=1e-8), backend="numpy")
    pf = gs.ParticleFilter(model, particles=50, seed=0)
    pf.initialize(mean=(-50.0, -50.0, 0.0), covariance=np.eye(3) * 1e-6)
    before = pf.particles
    pf.correct(np.full(60, np.nan))
    assert np.isfinite(pf.estimate().pose).all() and parameters.sigma_hit == 0.01
    assert np.array_equal(pf.particles[:, 2], before[:, 2])


def test_starts_have_their_densities():
    pf = gs.ParticleFilter(gps(), particles=50_000, seed=1)
    covariance = np.array([[0.5, 0.2, 0.0], [0.2, 0.3, 0.05], [0.0, 0.05, 0.1]])
    pf.initialize(mean=(1, 2, 0.5), covariance=covariance)
    found = pf.estimate()
    np.testing.assert_allclose(found.covariance, covariance, atol=0.01)
    np.testing.assert_allclose(found.pose, (1, 2, 0.5), atol=0.02)
    pf.initialize_uniform(bounds=[(0, 0), (2, 4)])
    np.testing.assert_allclose(np.var(pf.particles, axis=0), [4 / 12, 16 / 12, (2 * np.pi) ** 2 / 12], rtol=0.03)

    class Likelihood:
        log_p = np.log([0.75, 0.25, 1e-300])
        positions = np.array([(0.0, 0, 0), (1.0, 0, 0), (2.0, 0, 0)])

    pf.initialize_from(Likelihood())
    assert np.bincount(pf.particles[:, 0].round().astype(int)).tolist() == [37_500, 12_500]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: gs.ParticleFilter([]), "models: must be 1 to"),
        (lambda: gs.ParticleFilter(gps(), particles=(5, 2)), "particles: least must be at most"),
        (lambda: gs.ParticleFilter(gps(), temperature=2.0), "temperature: must be"),
        (lambda: gs.ParticleFilter(gps(), resampling="multinomial"), "resampling: must be"),
        (lambda: gs.ParticleFilter(gps(), stages=9), "stages: must be"),
        (lambda: gs.ParticleFilter(gps(), recovery="augmented"), "recovery: 'augmented' needs a model with a map"),
        (lambda: gs.ParticleFilter(gps()).initialize(mean=np.zeros(3), covariance=-np.eye(3)), "positive semidefinite"),
        (lambda: gs.ParticleFilter(gps()).initialize_uniform(), "bounds: must be given"),
        (lambda: gs.OdometryMotion(alpha=(-1, 0, 0, 0)), "alpha: must be >= 0"),
        (lambda: gs.fit_odometry_motion(np.zeros((2, 3)), np.zeros((2, 3))), "at least 3 poses"),
        (lambda: gs.fit_odometry_motion(np.zeros((9, 3)), np.zeros((9, 3))), "odometry: must move by .* got 0 m and 0"),
        (lambda: gs.fit_odometry_motion(np.eye(9, 3), np.full((9, 3), np.nan)), "poses: must hold at least 3 rows"),
        (lambda: gs.fit_odometry_motion(np.eye(3), [(0, 0, np.nan)] * 3), "poses: every value must be finite, got nan"),
    ],
)
def test_bad_input_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_the_algebra_of_poses():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 20, 3))
    np.testing.assert_allclose(gs.compose_poses(a, gs.pose_difference(a, b))[:, :2], b[:, :2], atol=1e-12)
    np.testing.assert_allclose(gs.compose_poses(a, gs.invert_poses(a)), 0, atol=1e-12)


def test_kld_sampling_asks_for_more_where_the_cloud_is_wide():
    rng = np.random.default_rng(0)
    narrow, wide = rng.normal(0, 0.05, (5000, 3)), rng.normal(0, 5, (5000, 3))
    assert kld_count(narrow, 100, 50_000) < 2000 < kld_count(wide, 100, 50_000)


def test_the_heaviest_cluster_is_found():
    rng = np.random.default_rng(0)
    one, two = rng.normal((0, 0, 3.1), 0.1, (300, 3)), rng.normal((9, 0, 0), 0.1, (200, 3))
    pose, covariance = clustered(np.vstack([one, two]), np.r_[np.full(300, 1.0), np.full(200, 1.1)])
    np.testing.assert_allclose(pose, (0, 0, 3.1), atol=0.03)
    np.testing.assert_allclose(np.diag(covariance), 0.01, rtol=0.3)


@pytest.mark.long_on("warp")
def test_readings_that_are_refused_cost_no_motion(backend):
    scanner = gs.Scanner.uniform(angle_min=-1, angle_increment=0.5, count=5, range_max=10.0)
    pf = gs.ParticleFilter(gs.LikelihoodFieldModel(GRID, scanner, backend=backend), particles=200)
    pf.initialize(mean=(3.0, 3.0, 0.0), covariance=np.diag([1e-4, 1e-4, 1e-6]))
    pf.predict((0, 0, 0), (1.0, 0, 0))
    with pytest.raises(ValueError, match="ranges: shape"):
        pf.correct(np.ones(4))
    pf.correct(np.full(5, np.nan))
    assert abs(pf.mean_and_covariance()[0][0] - 4.0) < 0.1


def placed(backend="numpy", **options):
    """Return a filter of a few particles near the truth."""
    model = gs.LikelihoodFieldModel(GRID, FINE, gs.LikelihoodFieldParameters(sigma_hit=0.1), backend=backend)
    pf = gs.ParticleFilter(model, particles=200, seed=1, **options)
    pf.initialize(mean=TRUTH, covariance=np.diag([0.01, 0.01, 1e-4]))
    return pf


def test_a_reset_keeps_the_motion_since_the_readings(backend):
    still, moved = placed(backend), placed(backend)
    for pf in (still, moved):
        pf.correct(scan_at(TRUTH, FINE))
    moved.predict((0, 0, 0), (0.5, 0, 0))
    for pf in (still, moved):
        pf.reset()
    ways = np.hypot(*(moved.host_particles() - still.host_particles())[:, :2].T)
    assert abs(np.median(ways) - 0.5) < 0.05


def test_particles_without_a_correction_are_all_effective(backend):
    pf = placed(backend)
    pf.correct(scan_at(TRUTH, FINE))
    pf.reset()
    assert pf.estimate().effective_sample_size == 200
    pf.initialize(mean=TRUTH, covariance=np.eye(3) * 0.01)
    assert pf.estimate().effective_sample_size == 200
    # Readings of the earlier particles have no information on these.
    with pytest.raises(RuntimeError, match="needs a correction first"):
        pf.reset()


def test_readings_may_be_overwritten_after_the_correction(backend):
    pf, ranges = placed(backend), scan_at(TRUTH, FINE)
    pf.correct(ranges)
    ranges[:] = np.nan
    assert pf.estimate().explained > 0.9


@pytest.mark.long_on("warp")
def test_a_filter_that_never_draws_keeps_what_it_knows(backend):
    """At a threshold below 1 / N, no weight may round to the integer 0."""
    pf = gs.ParticleFilter(gps(backend), particles=1000, seed=2, threshold=1e-15, stages=1)
    pf.initialize(mean=(0, 0, 0), covariance=np.diag([0.09, 0.09, 1e-6]))
    for _ in range(3):
        pf.correct(np.zeros(2))
    found = pf.estimate()
    # Three fixes with the start's variance leave a quarter of it.
    np.testing.assert_allclose(np.diag(found.covariance)[:2], 0.09 / 4, rtol=0.2)
    assert 100 < found.effective_sample_size < 1000


def test_a_fix_at_particles_without_weight_changes_nothing(backend):
    pf = gs.ParticleFilter(gps(backend), particles=200, seed=1, threshold=0.4)
    far = np.zeros((200, 3))
    far[120:, 0] = 50.0

    class Likelihood:
        log_p, positions = np.zeros(200), far

    pf.initialize_from(Likelihood())
    pf.correct(np.zeros(2))
    before = pf.estimate()
    assert before.effective_sample_size == pytest.approx(120, abs=1) and not before.degenerate
    pf.correct(np.array([50.0, 0.0]))
    found, weights = pf.estimate(), pf.host_weights()
    assert found.degenerate and found.effective_sample_size == pytest.approx(before.effective_sample_size)
    np.testing.assert_allclose(found.pose, before.pose, atol=1e-12)
    assert np.isfinite(weights).all() and weights[pf.host_particles()[:, 0] > 25].sum() == 0
