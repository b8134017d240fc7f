"""Batching, order, repetition, buffers and arguments change no result."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.model_world import BEARINGS, KINDS, NAN, RANGE, cloud, make, parts_of_kind, room, same_bits, scan

import gpusense as gs
from gpusense.backends.workspace import Workspace
from gpusense.models import chunking


@pytest.mark.sampled(0.5)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("chunk", [1, 7, 64])
def test_batches_do_not_matter(kind, chunk, backend, monkeypatch):
    grid, poses, z = room(), cloud(room(), 150), scan()
    log_p, parts = make(kind, grid, backend).log_likelihood(poses, z, per_beam=True)
    ranges = gs.RayCaster(grid, RANGE, backend=backend).cast(poses, BEARINGS)
    monkeypatch.setattr(chunking, "CHUNK", chunk)
    model = make(kind, grid, backend)
    again, each = model.log_likelihood(poses, z, per_beam=True)
    same_bits(log_p, again)
    same_bits(parts, each)
    same_bits(log_p, model.log_likelihood(poses, z))
    same_bits(ranges, gs.RayCaster(grid, RANGE, backend=backend).cast(poses, BEARINGS))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_order_and_repetition_do_not_matter(kind, precision, backend):
    grid, z = room(), scan()
    poses = cloud(grid, 301)
    model = make(kind, grid, backend, precision=precision)
    log_p = model.log_likelihood(poses, z)
    shuffled = np.random.default_rng(9).permutation(len(poses))
    same_bits(model.log_likelihood(poses[shuffled], z), log_p[shuffled])
    same_bits(model.log_likelihood(poses, z), log_p)
    same_bits(make(kind, grid, backend, precision=precision).log_likelihood(poses, z), log_p)
    same_bits(model.log_likelihood(poses[17:18], z), log_p[17:18])
    same_bits(model.log_likelihood(np.repeat(poses[:1], 5, axis=0), z), np.repeat(log_p[:1], 5))


@pytest.mark.parametrize("kind", KINDS)
def test_buffers_are_used_again(kind, backend):
    """The second call of a size, and smaller calls, allocate no memory."""
    grid, z = room(), scan()
    poses = cloud(grid, 200)
    model = make(kind, grid, backend)

    def held() -> list[tuple[Any, ...]]:
        spaces = parts_of_kind(model, Workspace)
        assert spaces
        return [(name, size, id(buffer)) for space in spaces for name, (size, buffer) in space._buffers.items()]

    model.log_likelihood(poses, z, per_beam=True)
    if kind == "beam":
        model.expected_ranges(poses)
    before = held()
    for count in (200, 200, 50, 1):
        some = np.where(np.arange(len(z)) < count, z, NAN)
        model.log_likelihood(poses[:count], some, per_beam=True)
        model.log_likelihood(poses[:count], z)
        if kind == "beam":
            model.expected_ranges(poses[:count])
    assert held() == before


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
