"""Short calls need no bounds of the poses, and allocate the next result while the device works."""

from __future__ import annotations

import numpy as np
import pytest
from support.array_libraries import to_device
from support.scan_calls import COUNT, FIELD, GRID, NEAR, cloud, mixed

import gpusense as gs
from gpusense.backends import arrays
from gpusense.evaluation.tolerances import differing
from gpusense.models.scan import packed_call


def test_short_calls_need_no_bounds_of_the_poses(batching, monkeypatch):
    """The table covers the whole map, and poses anywhere use it; a pose that is not finite is still named."""
    grid = gs.OccupancyGrid(np.pad(GRID.cells, 100), 0.1)
    model, plain = (FIELD(grid, NEAR, backend=batching[0]) for _ in range(2))
    plain._short = None
    for seed in range(3):
        model.log_likelihood(cloud(seed) + 10.0, mixed(seed))
    assert model._pipeline.map.window is model._pipeline.map._whole
    bounds, counted = arrays.bounds_of, []
    monkeypatch.setattr(arrays, "bounds_of", lambda poses: (counted.append(1), bounds(poses))[1])
    version = model.table_version
    for seed in range(3):
        poses = cloud(seed)
        poses[:, 1] += 5.0 * seed
        found = model.log_likelihood(poses, mixed(seed))
        assert not counted and model.table_version == version
        assert differing(found, plain.log_likelihood(poses, mixed(seed))) == 0
        counted.clear()
    poses[7, 0] = np.inf
    with pytest.raises(ValueError, match=r"poses: every value must be finite, got inf at index \(7, 0\)"):
        model.log_likelihood(poses, mixed(0))


def test_the_next_result_is_allocated_while_the_device_works(batching, monkeypatch):
    """A result that is ahead is used once, and only by a call of its size without ``out=``."""
    device, made, ended = batching[0], [], []
    empty_like, finish = device.empty_like, packed_call.PackedCall.score
    monkeypatch.setattr(device, "empty_like", lambda *given: (made.append(len(ended)), empty_like(*given))[1])
    monkeypatch.setattr(packed_call.PackedCall, "score", lambda *given: (finish(*given), ended.append(1))[0])
    model, plain = (FIELD(GRID, NEAR, backend=device) for _ in range(2))
    plain._short = None
    poses, ranges, found = to_device(cloud(0)), to_device(mixed(0)), []
    for seed in range(8):
        poses.assign(cloud(seed))
        made.clear()
        ended.clear()
        found.append(model.log_likelihood(poses, ranges))
        # During the call; the first short call also allocates its own.
        assert seed < 3 or (made == [0] and ended == [1])
    assert len({one.ptr for one in found}) == 8
    made.clear()
    out, few = to_device(np.zeros(COUNT, np.float32)), to_device(cloud(1)[:40])
    model.log_likelihood(poses, ranges, out=out)
    for _ in range(3):
        part = model.log_likelihood(few, ranges)
    assert differing(part.numpy(), plain.log_likelihood(few, ranges).numpy()) == 0
    for seed, one in enumerate(found):
        assert differing(one.numpy(), plain.log_likelihood(cloud(seed), mixed(0))) == 0
    assert differing(out.numpy(), plain.log_likelihood(poses, ranges).numpy()) == 0
