"""Paths of calls with few particles against the plain path: shared memory, batches of launches."""

from __future__ import annotations

import dataclasses
import itertools
import threading
from typing import Any

import numpy as np
import pytest
from support.array_libraries import to_device
from support.scan_calls import BEAMS, COUNT, GRID, MODELS, RANGE, SCANNER, cloud, scan

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.backends.workspace import Workspace
from gpusense.evaluation.tolerances import differing
from gpusense.models import chunking
from gpusense.models.scan import model as model_module
from gpusense.models.scan.packed_call import PackedCallCache


@pytest.fixture(autouse=True)
def no_short_calls(monkeypatch):
    """Keep repeated calls ordinary; test_bound_host.py tests the other ones."""
    monkeypatch.setattr(PackedCallCache, "of", staticmethod(lambda pipeline: None))


# ---- processors: memory of host and device


@pytest.fixture
def two_ways(needs, monkeypatch):
    """Return an OpenCL processor's backend that shares memory, and one that copies by commands."""
    from gpusense.backends.opencl import backend as _opencl

    selection = needs("opencl")
    shared = get_backend(selection)
    if not shared._shared:
        pytest.skip("the device does not share its memory with the host")
    monkeypatch.setattr(_opencl, "shares_memory", lambda device: False)
    return shared, _opencl.OpenCLBackend(shared.info, shared._device)


@pytest.mark.parametrize("kind", MODELS)
def test_shared_memory_changes_no_bit(kind, two_ways):
    models = [kind(GRID, SCANNER, backend=device) for device in two_ways]
    for seed, count in ((1, COUNT), (2, 40), (3, 700)):
        found, expected = (model.log_likelihood(cloud(seed, count), scan(seed)) for model in models)
        assert differing(found, expected) == 0
    found, expected = (model.log_likelihood(cloud(4), scan(4), per_beam=True) for model in models)
    assert differing(found[1], expected[1]) == 0


@pytest.mark.parametrize("kind", MODELS)
def test_parts_of_buffers_do_not_overlap_and_stay(kind, two_ways, monkeypatch):
    """Scans of different numbers of readings, which are uploaded as one array each."""
    made: list[tuple[Any, int, int]] = []

    def watched(buffer: Any, first: int, count: int, dtype: np.dtype) -> Any:
        made.append((buffer, first * dtype.itemsize, (first + count) * dtype.itemsize))
        return part(buffer, first, count, dtype)

    few, single, part = scan(1), np.full(BEAMS, np.nan), two_ways[1].part
    few[::3], single[4] = np.nan, 2.0
    calls = [(cloud(1), one) for one in (scan(1), few, single)]
    calls.append((np.stack([cloud(1), cloud(2)]), np.stack([scan(1), few])))
    monkeypatch.setattr(two_ways[1], "part", watched)
    expected, found = (kind(GRID, SCANNER, backend=device) for device in two_ways)
    for again in range(2):
        before = len(made)
        for call in calls:
            assert differing(found.log_likelihood(*call), expected.log_likelihood(*call)) == 0
        assert again == (len(made) == before)
    for (one, begin, end), (other, first, last) in itertools.combinations(made, 2):
        assert one is not other or end <= first or last <= begin


def test_uploads_of_many_sizes_keep_few_buffers(two_ways, monkeypatch):
    """Sizes share buffers; contents are right when buffers are dropped, and for arrays that are copied apart."""
    device, made = two_ways[1], []
    empty, space = device.empty, Workspace(device)
    monkeypatch.setattr(device, "empty", lambda *one, **how: (made.append(one), empty(*one, **how))[1])
    for other, size in itertools.product((3, 1000, 2000, 3000), (*range(1, 40_000, 500), 100_000)):
        arrays = [np.arange(size, dtype=np.float32), np.full(other, size, np.float32)]
        for array, part in zip(arrays, space.upload_all("some", arrays), strict=True):
            assert np.array_equal(device.download(part, np.empty_like(array)), array)
    assert 64 < len(made) < 130


def test_launches_see_the_contents_of_their_time(two_ways):
    """Copies stay in order with launches, and released memory lives until the launches have ended."""
    device, numpy = two_ways[0], get_backend("numpy")
    size, int32 = (200_000,), np.dtype(np.int32)
    results = []
    for one in (device, numpy):
        bounds, bins = one.empty(7, int32, zero=True), one.empty(32768, int32, zero=True)
        for value in (3, 5, 4):
            one.upload(np.full(7, value, np.int32), bounds, wait=False)
            cell, pose = (
                one.upload(np.full(2 * size[0], value, np.int32)),
                one.empty(4 * size[0], np.dtype("f4"), zero=True),
            )
            one.compile("order_bounds", frozenset())((32768,), cell, pose, bounds, bins, size[0])
            del cell, pose
            results.append(one.download(bounds, np.empty(7, np.int32), wait=False))
        one.synchronize()
    assert all(np.array_equal(a, b) for a, b in zip(results[:3], results[3:], strict=True))


def test_shared_memory_that_cannot_be_allocated(two_ways):
    """The result is a MemoryError, without any other message."""
    from gpusense.backends.opencl.memory import SharedBuffer, driver_errors

    with pytest.raises(MemoryError, match="out of memory"), driver_errors():
        SharedBuffer(two_ways[0]._context, 1 << 60, two_ways[0].synchronize)


# ---- CUDA: launches and copies in batches, and graphs; Warp's processor replaces a GPU


def plainly(device, monkeypatch, call):
    """Return a result without batches."""
    with monkeypatch.context() as patch:
        patch.setattr(device, "info", dataclasses.replace(device.info, graphs=False))
        return call()


@pytest.mark.parametrize("kind", MODELS)
def test_graphs_change_no_bit(kind, batching, monkeypatch):
    device, started = batching
    model = kind(GRID, SCANNER, backend=device)
    # Sizes that alternate, other readings, and poses with huge headings, which need other code.
    calls = [
        (seed, count, readings) for seed in range(4) for count, readings in ((COUNT, BEAMS), (50, BEAMS), (50, 20))
    ]
    for seed, count, readings in calls:
        poses, ranges = cloud(seed, count), scan(seed, readings)
        poses[0, 2] = 1e8 if seed == 3 else 0.5
        expected = plainly(device, monkeypatch, lambda p=poses, z=ranges: model.log_likelihood(p, z))
        assert differing(model.log_likelihood(poses, ranges), expected) == 0
        if kind is gs.BeamModel:
            # Code of stored calls also counts.
            inside = np.full((50, 3), 3.0)
            assert "ORIGINS_OUTSIDE" in model._last.flags
            model.log_likelihood(inside, ranges)
            assert "ORIGINS_OUTSIDE" not in model._last.flags
    # First calls of each of three sizes, and of other code, are plain.
    assert len(started) >= 3
    # A changed map updates the table or rebuilds it.
    for place in ((5, 6), (30, 30)):
        model.update_map(np.full((2, 3), 100), place)
        anew = kind(model.grid, SCANNER, backend=device)
        expected = plainly(device, monkeypatch, lambda anew=anew: anew.log_likelihood(cloud(9), scan(9)))
        for _ in range(3):
            assert differing(model.log_likelihood(cloud(9), scan(9)), expected) == 0


def test_scans_and_pieces_are_batched_in_their_order(batching, monkeypatch):
    """Pieces reuse buffers, so that a wrong order would change results."""
    device, started = batching
    monkeypatch.setattr(chunking, "CHUNK", 77)
    model = gs.LikelihoodFieldModel(GRID, SCANNER, backend=device)
    poses, scans = np.stack([cloud(1), cloud(2)]), np.stack([scan(1), scan(2)])
    expected = plainly(device, monkeypatch, lambda: model.log_likelihood(poses, scans))
    for _ in range(4):
        assert differing(model.log_likelihood(poses, scans), expected) == 0
    caster = gs.RayCaster(GRID, RANGE, backend=device)
    expected = plainly(device, monkeypatch, lambda: caster.cast(cloud(3), SCANNER.bearings))
    for _ in range(4):
        assert differing(caster.cast(cloud(3), SCANNER.bearings), expected) == 0
    assert started


@pytest.mark.parametrize("kind", MODELS)
def test_scans_that_share_launches_are_batched(kind, batching, monkeypatch):
    """Calls of several scans are not confused with calls of one scan with as many particles and readings."""
    device, started = batching
    model = kind(GRID, SCANNER, backend=device, temperature=0.5)
    poses = np.stack([cloud(1, 100), cloud(2, 100), cloud(3, 100)])
    calls = [
        (poses, np.stack([scan(4), scan(5), scan(6)])),
        (poses[::-1].copy(), np.stack([scan(7), scan(8), scan(9)])),
        (poses, np.stack([scan(4, 20), scan(5, 9), scan(6)])),
        (poses, np.stack([scan(4), scan(5, 9), scan(6, 20)])),
        (poses.reshape(1, 300, 3), scan(4)[None]),
        (poses.reshape(300, 3), scan(4)),
        (poses[:2], np.stack([scan(4), scan(5)])),
        (poses[:, :66], np.stack([scan(4), scan(5), scan(6, 0)])),
    ]
    expected = plainly(device, monkeypatch, lambda: [model.log_likelihood(*call) for call in calls])
    for _ in range(3):
        for call, wanted in zip(calls, expected, strict=True):
            assert differing(model.log_likelihood(*call), wanted) == 0
    assert len(started) >= len(calls)


@pytest.mark.parametrize("count", [COUNT, 0])
def test_several_models_are_batched(count, batching, monkeypatch):
    device, started = batching
    models = [kind(GRID, SCANNER, backend=device) for kind in (*MODELS, gs.LikelihoodFieldModel)]
    models.append(models[0])
    poses, z = [cloud(s, count) for s in range(4)], [scan(s) for s in range(4)]
    expected = plainly(
        device, monkeypatch, lambda: [m.log_likelihood(*one) for m, *one in zip(models, poses, z, strict=True)]
    )
    there = [to_device(own) for own in poses]
    for given in (poses, poses, poses, there, there, [poses[0], *there[1:]]):
        found = gs.log_likelihoods(models, given, z)
        assert all(
            differing(one if isinstance(one, np.ndarray) else one.numpy(), wanted) == 0
            for one, wanted in zip(found, expected, strict=True)
        )
    assert started or not count
    if count:
        bad = cloud(2)
        bad[5, 2] = np.inf
        with pytest.raises(ValueError, match="poses: must be finite, got a pose on the device"):
            gs.log_likelihoods(models, [there[0], there[1], to_device(bad), there[3]], z)
        # The error is reported once, and for no other model.
        assert differing(gs.log_likelihoods(models, there, z)[2].numpy(), expected[2]) == 0


def test_arrays_that_are_too_large_are_copied_at_once(batching, monkeypatch):
    from gpusense.backends.warp import queue as _warp_queue

    device, _ = batching
    model = gs.LikelihoodFieldModel(GRID, SCANNER, backend=device)
    expected = plainly(device, monkeypatch, lambda: model.log_likelihood(cloud(1), scan(1)))
    for largest, memory in ((1000, 4 << 20), (256 << 10, 2000), (0, 0)):
        monkeypatch.setattr(_warp_queue, "_LARGEST", largest)
        monkeypatch.setattr(_warp_queue, "_MEMORY", memory)
        for _ in range(3):
            assert differing(model.log_likelihood(cloud(1), scan(1)), expected) == 0


def test_a_call_that_fails_leaves_nothing_behind(batching, monkeypatch):
    """The table is complete, and arrays are never written later."""
    device, _ = batching
    model = gs.BeamModel(GRID, SCANNER, backend=device)
    other = gs.BeamModel(GRID, SCANNER, backend=device)
    expected = plainly(device, monkeypatch, lambda: other.log_likelihood(cloud(1), scan(1)))
    out = np.full(COUNT, 7, np.float32)
    with monkeypatch.context() as patch:
        patch.setattr(model_module, "finish", lambda *arguments: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            model.log_likelihood(cloud(1), scan(1), out=out)
    assert device.batch() is None and (out == 7).all()
    assert differing(model.log_likelihood(cloud(1), scan(1)), expected) == 0
    assert (out == 7).all()


def test_threads_have_batches_of_their_own(batching, monkeypatch):
    device, started = batching
    models = [gs.LikelihoodFieldModel(GRID, SCANNER, backend=device) for _ in range(3)]
    expected = plainly(device, monkeypatch, lambda: [models[0].log_likelihood(cloud(i), scan(i)) for i in range(3)])
    same: list[bool] = []

    def work(i: int) -> None:
        same.extend(differing(models[i].log_likelihood(cloud(i), scan(i)), expected[i]) == 0 for _ in range(10))

    threads = [threading.Thread(target=work, args=(i,)) for i in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(same) == 30 and all(same)
    # Warp records for the whole process, so nothing is recorded while other threads run.
    assert not started
    for _ in range(3):
        models[0].log_likelihood(cloud(0), scan(0))
    assert started


def test_graphs_of_copies_differ_by_the_type_of_their_numbers(batching):
    """Memory of a freed buffer may come back with numbers of another type."""
    device, started = batching
    double, single = np.dtype(np.float64), np.dtype(np.float32)
    memory = device.empty(8, double)
    for real in (single, double):
        halves = [device.part(memory, byte // real.itemsize, 4, real) for byte in (0, 32)]
        for turn in range(3):
            numbers = np.arange(4.0) + turn, np.arange(4.0) - turn
            with Workspace(device):
                for half, values in zip(halves, numbers, strict=True):
                    device.upload(values.astype(real), half, wait=False)
                device.synchronize()
            for half, values in zip(halves, numbers, strict=True):
                assert (device.download(half, np.empty(4, real)) == values).all()
    assert started


def test_graphs_are_bounded_and_a_driver_without_them_is_used_plainly(batching, monkeypatch):
    import warp as wp

    from gpusense.backends.warp import graphs as _warp_graphs

    device = batching[0]
    monkeypatch.setattr(_warp_graphs, "_MOST_GRAPHS", 2)
    monkeypatch.setattr(device, "_graphs", _warp_graphs.GraphCache(device._device))
    model = gs.LikelihoodFieldModel(GRID, SCANNER, backend=device)
    model.log_likelihood(cloud(0), scan(0))
    for count in (300, 200, 100, 50):
        for _ in range(3):
            model.log_likelihood(cloud(count, count), scan(1))
    # Two entries in use are never evicted for others, to avoid evicting in turn.
    graphs = device._graphs._graphs
    assert len(graphs) == 2
    held = {key for key, _ in graphs.items()}
    monkeypatch.setattr(graphs, "_patience", 4)
    for _ in range(4):
        model.log_likelihood(cloud(50, 50), scan(1))
    assert len(graphs) == 2 and {key for key, _ in graphs.items()} != held

    def refuse(*arguments, **options):
        raise RuntimeError("no graphs here")

    monkeypatch.setattr(wp, "capture_begin", refuse)
    expected = plainly(device, monkeypatch, lambda: model.log_likelihood(cloud(1, 77), scan(1)))
    for _ in range(3):
        assert differing(model.log_likelihood(cloud(1, 77), scan(1)), expected) == 0
    assert [capture.reason for _, capture in graphs.items()][-1] == "the driver captured no graph: no graphs here"


def test_an_error_forgets_no_memory_that_launches_still_need(batching, monkeypatch):
    """Launches of the batch start first."""
    device, int32, seen = batching[0], np.dtype(np.int32), []
    space, end_batch = Workspace(device), device.end_batch
    monkeypatch.setattr(
        device, "end_batch", lambda: (seen.append(("pose_status", int32) in space._buffers), end_batch())
    )
    with pytest.raises(KeyboardInterrupt), space:
        space.empty("pose_status", 2, int32, zero=True)
        raise KeyboardInterrupt
    assert seen == [True] and not space._buffers
