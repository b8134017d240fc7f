"""A device whose memory is full, and sizes that grow and shrink: models continue to work."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from support.model_world import BEARINGS, KINDS, NAN, RANGE, cloud, make, parts_of_kind, room, same_bits, scan

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.backends.proxy import Proxy
from gpusense.models import chunking
from gpusense.tables.reachable import ReachableMap


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


class FullDevice(Proxy):
    """A proxy that fails the allocations numbered in ``failing``, and too large allocations."""

    def __init__(self, backend: str) -> None:
        super().__init__(get_backend(backend))
        self.largest = 1 << 60
        self.failing: set[int] = set()
        self.calls = self.refused = 0

    def empty(self, count: int, dtype: np.dtype, **options: Any) -> Any:
        self.calls += 1
        if self.calls in self.failing or count > self.largest:
            self.refused += 1
            raise MemoryError("no room")
        return self._backend.empty(count, dtype, **options)


@pytest.mark.parametrize("kind", KINDS)
def test_a_launch_that_does_not_fit_is_halved(kind, backend):
    """A failure in the middle of a call costs a second try; the next call needs none."""
    grid, z = room(), scan()
    poses = cloud(grid, 3000)
    expected = make(kind, grid, backend).log_likelihood(poses, z)
    device = FullDevice(backend)
    model = make(kind, grid, device)
    model.log_likelihood(poses[:1], z)
    device.failing = {device.calls + 1}
    for _ in range(2):
        same_bits(model.log_likelihood(poses, z), expected)
        assert device.refused == 1


@pytest.mark.parametrize("kind", KINDS)
def test_whichever_allocation_fails_the_model_goes_on(kind, backend):
    """A call returns the correct result or raises MemoryError; the next call returns the correct result."""
    grid, z = room(), scan()
    poses = cloud(grid, 600)
    expected = make(kind, grid, backend).log_likelihood(poses, z)
    for number in range(1, 14):
        device = FullDevice(backend)
        model = make(kind, grid, device)
        device.failing = {device.calls + number}
        try:
            same_bits(model.log_likelihood(poses, z), expected)
        except MemoryError as error:
            assert str(error) == "no room"
        same_bits(model.log_likelihood(poses, z), expected)


@pytest.mark.parametrize("kind", [*KINDS, "caster"])
def test_a_table_that_does_not_fit_is_reported_at_once(kind, backend, monkeypatch):
    """Fewer particles need the same table, so it is tried once; the message is the device's."""
    grid, z = room(), scan()
    poses = cloud(grid, 3000)
    monkeypatch.setattr(chunking, "SMALLEST_CHUNK", 1)

    def score(device: Any) -> Any:
        if kind == "caster":
            caster = gs.RayCaster(grid, RANGE, backend=device)
            return caster, lambda: caster.cast(poses, BEARINGS)
        model = make(kind, grid, device)
        return model, lambda: model.log_likelihood(poses, z)

    device = FullDevice(backend)
    owner, call = score(device)
    (table,) = parts_of_kind(owner, ReachableMap)
    prepare, tried = table._prepare, []

    def refuse(*arguments):
        tried.append(arguments)
        device.largest = 10
        return prepare(*arguments)

    table._prepare = refuse
    with pytest.raises(MemoryError, match=r"^no room$"):
        call()
    assert len(tried) == device.refused == 1
    table._prepare, device.largest = prepare, 1 << 60
    same_bits(call(), score(backend)[1]())


def test_a_small_device_scores_in_pieces(backend):
    grid, z = room(), scan()
    poses = cloud(grid, 3000)
    device = FullDevice(backend)
    model, caster = make("beam", grid, device), gs.RayCaster(grid, RANGE, backend=device)
    model.log_likelihood(poses[:1], z)
    caster.cast(poses[:1], BEARINGS)
    device.largest = 24 * 800
    log_p, parts = model.log_likelihood(poses, z, per_beam=True)
    ranges = caster.cast(poses, BEARINGS)
    assert device.refused > 1
    expected, each = make("beam", grid, backend).log_likelihood(poses, z, per_beam=True)
    same_bits(log_p, expected)
    same_bits(parts, each)
    same_bits(ranges, gs.RayCaster(grid, RANGE, backend=backend).cast(poses, BEARINGS))
