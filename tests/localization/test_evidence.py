"""The verdict of a filter among landmarks before it has seen enough features."""

from __future__ import annotations

import numpy as np
import pytest

import gpusense as gs

POINTS = np.random.default_rng(0).uniform(0, 20, (14, 2))


def features_at(pose, rng):
    """Return ranges and bearings of the landmarks within 8 m, with noise."""
    d = POINTS - pose[:2]
    found = np.column_stack([np.hypot(*d.T), gs.wrap_angle(np.arctan2(d[:, 1], d[:, 0]) - pose[2])])
    return (found + rng.normal(0, (0.05, 0.02), found.shape))[found[:, 0] < 8]


def followed(points, scans=24):
    """Return a filter after a circle among ``POINTS`` on a map with ``points``."""
    model = gs.LandmarkModel(gs.LandmarkMap(points), backend="numpy")
    pf, rng = gs.ParticleFilter(model, particles=300, seed=2), np.random.default_rng(3)
    pose, odometry = np.array([6.0, 6.0, 0.0]), np.zeros(3)
    pf.initialize(mean=pose, covariance=np.diag([0.1, 0.1, 0.02]))
    for _ in range(scans):
        pose, after = (gs.compose_poses(p, (0.5, 0, 0.1)) for p in (pose, odometry))
        pf.predict(odometry, after)
        pf.correct((features_at(pose, rng),))
        odometry = after
    return pf, pose


def test_there_is_no_verdict_before_enough_features():
    pf, _ = followed(POINTS, scans=5)
    pf.correct((np.zeros((0, 2)),))
    assert not pf.estimate().lost
    with pytest.raises(ValueError, match="features"):
        pf.correct((np.zeros(3),))
