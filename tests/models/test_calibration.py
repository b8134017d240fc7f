"""Readings that a model draws have the density by which it scores them: ranks in posteriors are uniform."""

from __future__ import annotations

import numpy as np
import pytest
from support.calibration import assert_uniform, posterior_ranks

import gpusense as gs

RUNS = 400
NUMPY = dict(backend="numpy", precision="float64")
GRID = gs.worlds.building(seed=4, size=(12.0, 10.0), resolution=0.1)
WIDE = gs.BeamParameters(
    z_hit=0.6, z_short=0.2, z_max=0.1, z_rand=0.1, sigma_hit=0.3, lambda_short=0.5, range_bias=0.1, sigma_growth=0.05
)
LASER = gs.Scanner(np.linspace(-2.0, 2.0, 4), range_max=5.0, mount=(0.1, 0.0, 0.2))
SONAR = gs.Scanner(np.linspace(-2.0, 2.0, 3), range_max=4.0, cone=0.3, cone_rays=3, critical_incidence=0.8)
BY_INCIDENCE = gs.IncidenceParameters(
    (0, 0.5, 1.0, np.pi / 2), (WIDE, WIDE.replace(sigma_hit=0.6), WIDE.replace(z_hit=0.3, z_max=0.4)),
    WIDE.replace(z_hit=0.1, z_max=0.6),
)  # fmt: skip
TABLE = gs.DiscreteBeamModel(gs.DiscreteCauses(p_detect=0.4), range_max=5.0, bins=20)
SCAN_MODELS = {
    "beam": (LASER, WIDE, {}),
    "beam, coarse": (LASER, WIDE.replace(sigma_hit=4.0, z_max=0.0, z_rand=0.2), {}),
    "beam, incidence": (LASER, None, dict(incidence=BY_INCIDENCE)),
    "table": (LASER, TABLE, {}),
    "sonar": (SONAR, WIDE, {}),
    "look-up": (LASER, WIDE, dict(caster=gs.casters.Lookup(bins=60))),
    "marching": (LASER, WIDE, dict(caster="march")),
}
MAP = gs.LandmarkMap([(1.0, 1.0), (4.0, 2.0), (2.0, 4.0)], signatures=[1.0, 2.0, 3.0])
WIDE_LANDMARKS = gs.LandmarkParameters(
    sigma_range=0.8, sigma_bearing=0.9, sigma_signature=0.5, z_detect=0.7, z_false=0.3, range_max=8.0
)
POINT_MODELS = {
    "fix": gs.PositionModel(
        gs.PositionParameters(covariance=((1.0, 0.6), (0.6, 2.0)), z_hit=0.7, z_rand=0.3, region=(-9, -9, 15, 15),
                              mount=(0.5, 0.2)), **NUMPY),
    "heading": gs.HeadingModel(gs.HeadingParameters(sigma=0.8, z_hit=0.8, z_rand=0.2, offset=7.0), **NUMPY),
    "heading, wide": gs.HeadingModel(gs.HeadingParameters(sigma=2.0), **NUMPY),
    "von Mises": gs.HeadingModel(gs.HeadingParameters(kind="von_mises", kappa=1.5), **NUMPY),
    **{kind: gs.BeaconModel(MAP.xy, gs.BeaconParameters(kind=kind, sigma_range=0.7, bias=(0.3, -0.2, 0.1), nu=3,
                                                        range_max=9.0, mount=(0.2, 0.0)), **NUMPY)
       for kind in ("normal", "student_t", "mixture")},
    "bumper": gs.BumperModel(GRID, 0.3, gs.BumperParameters(p_contact=0.8, p_false=0.2, sigma=0.3),
                             segments=[(0, 2), (2, 4)], **NUMPY),
}  # fmt: skip
VIEWS = {"all around": WIDE_LANDMARKS, "narrow": WIDE_LANDMARKS.replace(field_of_view=4.0, range_max=6.0)}


def poses_of(count: int, low: tuple[float, ...], high: tuple[float, ...]) -> np.ndarray:
    return np.random.default_rng(5).uniform(low, high, (count, 3))


@pytest.mark.parametrize("name", SCAN_MODELS)
def test_readings_of_scans_are_calibrated(name):
    scanner, parameters, options = SCAN_MODELS[name]
    model = gs.BeamModel(GRID, scanner, parameters, **options, **NUMPY)
    poses = gs.worlds.cloud_uniform(GRID, 8, np.random.default_rng(6))
    assert_uniform(posterior_ranks(poses, model.sample, model.log_likelihood, RUNS))


@pytest.mark.parametrize("name", POINT_MODELS)
def test_readings_of_point_models_are_calibrated(name):
    model = POINT_MODELS[name]
    low, high = ((0.5, 0.5, -3.1), (11.5, 9.5, 3.1)) if name == "bumper" else ((0, 0, -3.1), (5, 5, 3.1))
    poses = poses_of(15, low, high)
    assert_uniform(posterior_ranks(poses, model.sample, model.log_likelihood, RUNS))


@pytest.mark.parametrize("view", VIEWS)
def test_features_with_known_landmarks_are_calibrated(view):
    model = gs.LandmarkModel(MAP, VIEWS[view], mount=(0.2, 0.1, 0.3), **NUMPY)
    partner = [0, 1, 2, -1]
    # Poses that see all landmarks: features beyond the limits are left out, and that says something, too.
    poses = poses_of(15, (-1.0, 0.0, -3.1), (5.0, 5.0, 3.1))
    if view == "narrow":
        middle = MAP.xy.mean(axis=0)
        poses[:, :2] = middle + (-5.0, 0.0) + 0.3 * poses[:, :2]
        poses[:, 2] = -0.3 + 0.05 * poses[:, 2]

    def score(at: np.ndarray, features: np.ndarray) -> np.ndarray:
        return model.log_likelihood(at, features, correspondence=partner)

    ranks = posterior_ranks(poses, lambda at, seed: model.sample(at, seed, correspondence=partner), score, RUNS)
    assert_uniform(ranks)


def test_detections_are_calibrated_with_negative_information():
    # Without false positives, what is not detected is all that negative information scores.
    certain = WIDE_LANDMARKS.replace(z_detect=1.0, z_false=0.0, p_detect=0.6, field_of_view=2 * np.pi, range_max=40.0)
    model = gs.LandmarkModel(MAP, certain, **NUMPY)
    features = model.sample(np.tile(poses_of(1, (0, 0, 0), (5, 5, 1)), (4000, 1)), seed=3)
    detected = np.isfinite(features).all(axis=-1)
    assert np.array_equal(detected, np.isfinite(features).any(axis=-1))
    assert abs(detected.mean() - 0.6) < 4 * np.sqrt(0.24 / detected.size)


def test_a_wrong_deviation_is_found():
    # The tests above can fail: readings of a sensor with another deviation are not calibrated.
    poses = gs.worlds.cloud_uniform(GRID, 8, np.random.default_rng(6))
    right, wrong = (gs.BeamModel(GRID, LASER, WIDE.replace(sigma_hit=sigma), **NUMPY) for sigma in (0.3, 1.5))
    ranks = posterior_ranks(poses, wrong.sample, right.log_likelihood, RUNS)
    with pytest.raises(AssertionError, match="p = "):
        assert_uniform(ranks)
