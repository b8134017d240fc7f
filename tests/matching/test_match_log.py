"""Matches of a log's scans share points and lines, and equal single matches of the pairs."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from support.matching_scenes import RING, ROOM, segments_scan, table_legs
from support.selection import present

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.matching.match import WINDOW, match_log
from gpusense.matching.noise import match_noise, scan_noise


@pytest.mark.parametrize("moving", [False, True])
def test_matches_of_a_log_are_those_of_its_pairs(moving):
    """A scan in pairs of several noise levels has lines for each level."""
    rng = np.random.default_rng(0)
    path = np.cumsum(rng.uniform(-0.1, 0.15, (9, 3)), axis=0)
    noise = np.array([0.01, 0.04, 0.01, 0.02, 0.08, 0.01, 0.02, 0.01, 0.04])
    walls = np.concatenate([ROOM, table_legs(1)])
    scans = np.array([segments_scan(walls, tuple(pose), RING) for pose in path])
    scans += noise[:, None] * rng.normal(size=scans.shape)
    motion = rng.uniform(-0.05, 0.05, (9, 3)) if moving else None
    first, second = np.array([0, 0, 1, 2, 2, 3, 5, 0, 7]), np.array([1, 2, 2, 3, 4, 5, 6, 7, 8])
    guess, own = rng.uniform(-0.1, 0.1, (9, 3)), scan_noise(scans, RING)
    levels = np.unique(match_noise(own[first], own[second]))
    device = present("opencl")
    found = match_log(scans, RING, first, second, guess, own, get_backend(device), "float32", WINDOW, motion)
    expected = gs.match_scan(
        scans[first], scans[second], RING, guess, backend=device,
        motion=None if motion is None else motion[second], reference_motion=None if motion is None else motion[first],
    )  # fmt: skip
    assert len(levels) >= 3
    for field in dataclasses.fields(found):
        np.testing.assert_array_equal(getattr(found, field.name), getattr(expected, field.name), err_msg=field.name)
