"""Readings drawn from a model follow the density that scores them: ranks in posteriors are uniform."""

from __future__ import annotations

import numpy as np
import pytest
from support.calibration_scenes import MAKERS, assert_uniform, make_scene, posterior_ranks

import gpusense as gs

RUNS = 300


@pytest.mark.sampled(0.3)
@pytest.mark.parametrize("name", MAKERS)
def test_readings_are_calibrated(name):
    scene = make_scene(name)
    assert_uniform(posterior_ranks(scene.poses, scene.draw, scene.score, RUNS))


def test_every_model_of_a_density_has_a_scene():
    models = {name for name in dir(gs) if name.endswith("Model") and hasattr(getattr(gs, name), "sample")}
    # The field refuses to draw readings.
    assert models - {"LikelihoodFieldModel"} == {type(make_scene(name).model).__name__ for name in MAKERS}


def test_poses_of_a_narrow_view_see_all_landmarks():
    # Otherwise a feature's absence would also be information.
    scene = make_scene("landmarks, narrow view")
    model = scene.model
    at = gs.compose_poses(scene.poses, model.mount)
    for landmark in model.landmarks.xy:
        x, y = (landmark - at[:, :2]).T
        assert np.hypot(x, y).max() < model.parameters.range_max
        assert np.abs(gs.wrap_angle(np.arctan2(y, x) - at[:, 2])).max() < model.parameters.field_of_view / 2


WRONG = {
    "heading": dict(sigma=1.2), "heading, von Mises": dict(kappa=0.8), "beacons, normal": dict(sigma_range=3.0),
    "position fix": dict(covariance=((6.0, 3.6), (3.6, 12.0))),
}  # fmt: skip


@pytest.mark.sampled(0.5)
@pytest.mark.parametrize("name", WRONG)
def test_another_density_is_found(name):
    # The test above can fail: readings of a sensor with other parameters are not calibrated.
    scene = make_scene(name)
    model = scene.model
    parameters = model.parameters.replace(**WRONG[name])
    options = dict(xy=model.xy) if name.startswith("beacons") else {}
    other = type(model)(parameters=parameters, backend="numpy", **options)
    ranks = posterior_ranks(scene.poses, other.sample, scene.score, 4 * RUNS)
    with pytest.raises(AssertionError, match="p = "):
        assert_uniform(ranks)


def test_ranks_of_a_known_posterior():
    # Two poses and a reading without information: the poses' ranks are uniform below and above one half.
    poses = np.array([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0)])
    ranks = posterior_ranks(poses, lambda at, seed: np.zeros(len(at)), lambda at, z: np.zeros(len(at)), 1000, seed=3)
    assert_uniform(ranks)
    # A reading that determines the pose.
    ranks = posterior_ranks(poses, lambda at, seed: at[:, 0], lambda at, z: -1e3 * np.abs(at[:, 0] - z), 1000, seed=3)
    assert_uniform(ranks)
