"""Calls of the landmark model and of the sensors without a scan: impossible features, poses on a device, ``out=``."""

from __future__ import annotations

import numpy as np
import pytest
from support import landmark_scenes as scenes
from support.absolute_scenes import GRID, poses_around
from support.array_libraries import to_device

import gpusense as gs

INF = float("inf")
IMPOSSIBLE = {
    "below 0": (-0.001, 0.1, 2.0), "too far": (12.001, 0.1, 2.0), "infinitely far": (INF, 0.1, 2.0),
    "behind": (3.0, 2.5, 2.0), "no angle": (3.0, -INF, 2.0), "no signature": (3.0, 0.1, 99.0),
    "no number": (3.0, 0.1, INF), "nothing": (np.nan, np.nan, np.nan),
}  # fmt: skip


@pytest.mark.parametrize("name", IMPOSSIBLE)
@pytest.mark.parametrize("how", ["nearest", "joint", "negative"])
def test_features_that_the_sensor_cannot_measure_are_left_out(name, how):
    """Live data must not stop a filter: such a feature counts as missing, and ``explain`` counts it."""
    options = {"negative": True} if how == "negative" else {"association": how}
    model, poses, features = scenes.model("everything", "numpy", **options)
    with_it = np.insert(features, 2, IMPOSSIBLE[name], axis=0)
    expected = model.log_likelihood(poses, features)
    np.testing.assert_array_equal(model.log_likelihood(poses, with_it), expected)
    text = "1 of 6 features have a part that the sensor cannot measure"
    assert (text in model.explain()) == (name != "nothing")
    which, parts = model.associate(poses, with_it)
    assert (which[:, 2] == -1).all() and (parts[:, 2] == 0).all()
    for found, expected in zip((which, parts), model.associate(poses, features), strict=True):
        np.testing.assert_array_equal(np.delete(found, 2, axis=1), expected)
    expected = model.log_likelihood(poses, features, [0, 2, 4, 5, 6])
    np.testing.assert_array_equal(model.log_likelihood(poses, with_it, [0, 2, 1, 4, 5, 6]), expected)


def test_limits_of_the_sensor_are_possible():
    p = gs.LandmarkParameters(range_max=12.0, field_of_view=2.0)
    model = gs.LandmarkModel(gs.LandmarkMap([[3.0, 0.0]]), p, backend="numpy")
    for feature in ([0.0, 0.0], [12.0, 0.0], [3.0, 1.0], [3.0, -1.0]):
        assert model.log_likelihood([[0, 0, 0]], [feature])[0] != 0


# ---------------------------------------------------------------------------------------------- where the poses are

POSES = poses_around(GRID, 60)
FEATURES = np.array([[3.0, 0.1], [6.0, np.nan], [2.0, -2.0]])


def test_associations_of_poses_on_the_device(warp_as_gpu):
    model = gs.LandmarkModel(gs.LandmarkMap([(5e6, 0.0), (5e6 + 9, 3.0)]), backend=warp_as_gpu)
    there, here = model.associate(to_device(POSES), FEATURES), model.associate(POSES, FEATURES)
    for found, expected in zip(there, here, strict=True):
        assert isinstance(found, np.ndarray)
        np.testing.assert_array_equal(found, expected)
