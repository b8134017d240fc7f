"""Poses of a localiser in a bag: covariances, odd messages and choices of a topic."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest
from support.bags import Writer

from gpusense.logs.bag_poses import read_poses

TIMES = np.arange(5.0) + 10


def write(folder, put, kind="mcap"):
    with Writer(folder, kind) as bag:
        put(bag)
    return bag.path


def test_zero_covariances_are_unknown(tmp_path):
    def put(bag):
        for time, variance in zip(TIMES, (0.0, 0.04, 0.09, 0.0, 0.01), strict=True):
            bag.pose(time, time, 0.0, 0.1, covariance=(variance,) * 3)

    found = read_poses(write(tmp_path, put), TIMES)
    assert found.source == "/amcl_pose" and found.covariances is not None
    assert np.isnan(found.covariances[:, 0, 0]).tolist() == [True, False, False, True, False]
    np.testing.assert_allclose(found.covariances[1], 0.04 * np.eye(3))
    np.testing.assert_allclose(found.poses[:, 0], TIMES)


def test_poses_are_sorted_and_the_last_of_equal_times_counts(tmp_path):
    def put(bag):
        for time, x in ((11.0, 1.0), (10.0, 0.0), (12.0, 5.0), (12.0, 2.0)):
            bag.pose(13.0, x, 0.0, 0.0, stamp=time)

    found = read_poses(write(tmp_path, put), TIMES, topic="amcl_pose")
    assert found.times.tolist() == [10.0, 11.0, 12.0] and found.poses[:, 0].tolist() == [0.0, 1.0, 2.0]
    assert found.covariances is None


def test_bad_poses_are_skipped_and_counted(tmp_path):
    def put(bag):
        for k, x in enumerate((1.0, math.nan, 2.0)):
            bag.pose(10.0 + k, x, 0.0, 0.0, frame="world")

    path = write(tmp_path, put)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = read_poses(path, TIMES)
    text = " ".join(str(one.message) for one in caught)
    assert found.poses[:, 0].tolist() == [1.0, 2.0]
    assert "skipped messages: 1 on /amcl_pose" in text and "are in the frame 'world'" in text


def test_transforms_come_before_topics(tmp_path):
    def put(bag):
        bag.transform(10.0, "map", "odom", (1.0, 2.0), math.pi / 2)
        for time in TIMES[:3]:
            bag.transform(time, "odom", "base_footprint", (time, 0.0), 0.0, topic="/tf")
            bag.pose(time, 9.0, 9.0, 0.0)

    path = write(tmp_path, put)
    found = read_poses(path, TIMES)
    assert found.source == "the transforms from map to base_footprint"
    np.testing.assert_allclose(found.poses, [[1.0, 2.0 + time, math.pi / 2] for time in TIMES[:3]])
    assert read_poses(path, TIMES, topic="/amcl_pose").source == "/amcl_pose"
    # Without transforms from this frame, the only topic counts; its frame is another one.
    with pytest.warns(UserWarning, match="are in the frame 'map'"):
        assert read_poses(path, TIMES, map_frame="world").source == "/amcl_pose"
    with pytest.raises(ValueError, match="poses: must be known by the transforms"):
        read_poses(path, TIMES, topic="/tf", map_frame="world")
