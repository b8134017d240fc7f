"""Matches of a log by index: information of a chain along directions that few pairs observe."""

from __future__ import annotations

import numpy as np
import pytest
from support.matching_scenes import CORRIDOR, segments_scan, table_legs
from support.selection import present

import gpusense as gs
from gpusense.chaining.matcher import SURE, Matcher
from gpusense.chaining.options import ChainOptions

FRONT = gs.Scanner.uniform(angle_min=-np.pi / 2, angle_increment=np.pi / 180, count=181, range_max=12.0)
MOVED = np.array([0.6, 0.1, 0.3])


def log(scenes: list[np.ndarray]) -> np.ndarray:
    """Return noisy scans of scenes, first all before and then all after a motion."""
    scans = [segments_scan(walls, tuple(pose), FRONT) for pose in (np.zeros(3), MOVED) for walls in scenes]
    return np.array(scans) + np.random.default_rng(0).normal(0, 0.01, (2 * len(scenes), FRONT.count))


@pytest.mark.parametrize("scene", ["furniture", "corridor"])
def test_directions_that_few_pairs_observe_are_taken_among_furniture_alone(scene):
    shifts = np.linspace(-0.3, 0.3, 12)[:, None] * (0, 1, 0, 1)
    scenes = [table_legs(seed) for seed in range(12)] if scene == "furniture" else [CORRIDOR + s for s in shifts]
    options = ChainOptions((0, 0), (0.5, 0.5), 0.0, None, False, present("opencl"), "float32")
    matcher, first = Matcher(log(scenes), FRONT, options), np.arange(12)
    found = matcher.match(first, first + 12, np.tile(MOVED, (12, 1)))
    lost = (found.eigenvalues == 0) & (found.usable & (found.p_right >= SURE))[:, None]
    taken = matcher.observed(first, first + 12, found)
    more = (taken.eigenvalues > 0) & (found.eigenvalues == 0)
    rows = more.any(axis=1)
    assert np.count_nonzero(lost.any(axis=1)) >= 8
    assert (np.count_nonzero(rows) >= 5) if scene == "furniture" else not rows.any()
    assert (more == lost)[rows].all() and not (more & ~lost).any()
    # Each of these directions gets a deviation of 4 cm before the temperature; other directions are unchanged.
    axes = found.directions * np.stack([np.ones(12), np.ones(12), 1 / found.lever], axis=1)[:, None]
    gained = np.einsum("lki,lij,lmj->lkm", axes, taken.information - found.information, axes)
    np.testing.assert_allclose(gained, np.eye(3) * more[:, :, None] / 0.04**2, rtol=1e-6, atol=1e-3)
    assert taken.pose is found.pose and (taken.information[~rows] == found.information[~rows]).all()
