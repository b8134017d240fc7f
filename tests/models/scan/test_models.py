"""Batching, order, repetition, buffers and arguments change no result."""

from __future__ import annotations

import numpy as np
import pytest
from support.model_world import BEARINGS, KINDS, NAN, cloud, make, room, same_bits, scan


@pytest.mark.parametrize("kind", KINDS)
def test_clouds_and_scans_that_grow_and_shrink(kind, backend):
    """A model used with many sizes returns the results of new models."""
    grid, rng = room(), np.random.default_rng(12)
    model = make(kind, grid, backend)
    for count in (1, 2, 3, 5, 8, 4, 31, 30, 47, 100, 7):
        z = np.where(rng.random(len(BEARINGS)) < rng.random(), scan(seed=count), NAN)
        poses = cloud(grid, count, seed=count)
        log_p, parts = model.log_likelihood(poses, z, per_beam=True)
        fresh, each = make(kind, grid, backend).log_likelihood(poses, z, per_beam=True)
        same_bits(log_p, fresh)
        same_bits(parts, each)


def test_arguments_are_left_alone(backend):
    grid, z = room(), scan()
    poses = cloud(grid, 20)
    before = poses.copy(), z.copy()
    model = make("beam", grid, backend)
    log_p = model.log_likelihood(poses, z)
    np.testing.assert_array_equal(poses, before[0])
    np.testing.assert_array_equal(z, before[1])
    kept = log_p.copy()
    model.log_likelihood(poses + 0.5, z)
    np.testing.assert_array_equal(log_p, kept)
    same_bits(model.log_likelihood(np.asfortranarray(poses), np.repeat(z, 2)[::2]), log_p)
    same_bits(model.log_likelihood(poses.tolist(), z.tolist()), log_p)
