"""Bound calls with arrays on a queue of pyopencl, and with NumPy arrays that are copied to it."""

from __future__ import annotations

import gc
import re
import weakref
from typing import Any

import numpy as np
import pytest
from support.scan_calls import BEAMS, CASES, COUNT, FIELD, GRID, MODELS, NEAR, cloud, mixed

from gpusense.evaluation.tolerances import differing


@pytest.mark.sampled(0.3)
@pytest.mark.parametrize("case", CASES)
def test_bound_calls(case, as_gpu, queue, there):
    """Bound calls return the bits of an ordinary call with the present arrays, NumPy's included, and map."""
    model = CASES[case](backend=queue)
    beams = model.scanner.count
    for real in (np.float32, np.float64):
        poses, ranges = there(cloud(0).astype(real)), there(np.zeros(beams, real))
        host = [np.zeros((COUNT, 3), real), np.zeros(beams, real)]
        call, staged = model.bind(poses, ranges), model.bind(*host)
        assert not call.waits and type(call.out) is type(poses) and staged.packed is not None
        for seed in (1, 2, 3):
            host[0][...], host[1][...] = cloud(seed), mixed(seed)[:beams]
            poses.set(host[0])
            ranges.set(host[1])
            if seed == 3:
                model.update_map(np.full((2, 3), 100), (5, 6))
            expected = model.log_likelihood(poses, host[1]).get()
            assert call() is call.out
            call.check()
            assert differing(call.out.get(), expected) == 0, (seed, real)
            assert differing(staged(), model.log_likelihood(*host)) == 0, (seed, real)
    host[0][3, 1] = np.nan
    with pytest.raises(ValueError, match="poses: every value must be finite, got nan at index"):
        staged()
    poses.set(host[0])
    call()
    with pytest.raises(ValueError, match="poses: must be finite"):
        call.check()
    poses.set(cloud(1).astype(real))
    call()
    call.check()


def test_bound_calls_on_another_queue(as_gpu, queue, there):
    import pyopencl as cl

    model, other = FIELD(GRID, NEAR, backend=queue), cl.CommandQueue(queue.context)
    poses, ranges = there(cloud(1)), there(mixed(1))
    expected = model.log_likelihood(poses, ranges).get()
    call = model.bind(poses, ranges, out=there(np.zeros(COUNT, np.float32)))
    for stream in (None, other, other):
        call.out.fill(0)
        queue.finish()
        call(stream)
        call.check()
        assert differing(call.out.get(), expected) == 0
    stranger = cl.CommandQueue(cl.Context([queue.device]))
    for stream in ("a stream", stranger):
        with pytest.raises(TypeError, match=r"^stream: must be a queue of the model's context and device, got"):
            call(stream)
    properties = cl.command_queue_properties.OUT_OF_ORDER_EXEC_MODE_ENABLE
    with pytest.raises(ValueError, match="stream: must be an in-order queue"):
        call(cl.CommandQueue(queue.context, properties=properties))
    # Memory in use by a queue is never freed.
    call(other)
    del call
    gc.collect()


def test_a_bound_call_binds_no_argument_again(as_gpu, queue, there, monkeypatch):
    """A call is three launches with private kernel objects."""
    from gpusense.backends.opencl import programs as _programs

    model = FIELD(GRID, NEAR, backend=queue)
    call = model.bind(there(cloud(1)), there(mixed(1)))
    names, enqueue = [], _programs.cl.enqueue_nd_range_kernel
    monkeypatch.setattr(
        _programs.cl, "enqueue_nd_range_kernel",
        lambda queue, kernel, *sizes: (names.append(kernel.function_name), enqueue(queue, kernel, *sizes))[1],
    )  # fmt: skip
    monkeypatch.setattr(as_gpu, "compile", None)
    call()
    # PoCL's kernels have a hash behind their names.
    assert [re.sub("_[0-9a-f]{24}$", "", name) for name in names] == ["place_inputs", "field_blocks", "sum_parts"]


def test_a_bound_call_whose_device_is_gone(as_gpu, queue, there, monkeypatch):
    import pyopencl as cl

    call = FIELD(GRID, NEAR, backend=queue).bind(there(cloud(1)), there(mixed(1)))
    expected = call().get()

    def gone(*arguments):
        raise cl.RuntimeError("clEnqueueNDRangeKernel failed: DEVICE_NOT_AVAILABLE")

    with monkeypatch.context() as patch:
        patch.setattr(cl, "enqueue_nd_range_kernel", gone)
        with pytest.raises(RuntimeError, match="no longer available, make a new model"):
            call()
    assert differing(call().get(), expected) == 0


def test_a_bound_call_of_numpy_arrays_copies_once_each_way(as_gpu, queue, copies, monkeypatch):
    """The call makes no buffer, and copies only poses, readings, results and the status of the poses."""
    for kind in MODELS:
        call = kind(GRID, NEAR, backend=queue).bind(cloud(1).astype(np.float32), mixed(1))
        call()
        copies.clear()
        with monkeypatch.context() as patch:
            for name in ("compile", "empty", "empty_external"):
                patch.setattr(as_gpu, name, None)
            call()
        (up, sent), (down, received) = copies
        assert (up, down) == ("up", "down")
        assert 8 * (3 * COUNT + BEAMS) <= sent < 8 * (3 * COUNT + BEAMS) + 2048
        assert 4 * COUNT + 8 <= received < 4 * COUNT + 8 + 2048


def test_a_new_table_finds_room(as_gpu, queue, there, monkeypatch):
    """Recorded launches release the old table before the new one is made."""
    model = FIELD(GRID, NEAR, backend=queue, specialize=False)
    call = model.bind(there(cloud(1)), there(mixed(1)))
    expected = call().get()
    old, prepare, alive = weakref.ref(call._table), model._pipeline.map._prepare, []

    def look(*given: Any) -> Any:
        gc.collect()
        alive.append(old() is not None)
        return prepare(*given)

    monkeypatch.setattr(model._pipeline.map, "_prepare", look)
    model._pipeline.map.drop()
    assert differing(call().get(), expected) == 0 and alive == [False]


def test_processors_take_the_ordinary_path(queue, there):
    """Their vector kernels take scans that the host prepared."""
    if queue.device.type & 4:
        pytest.skip("the device is a GPU")
    model = FIELD(GRID, NEAR, backend=queue)
    poses, ranges = there(cloud(1)), there(mixed(1))
    call = model.bind(poses, ranges)
    assert call.waits and call() is call.out
    assert differing(call.out.get(), model.log_likelihood(cloud(1), mixed(1))) == 0


def test_bound_arrays_must_begin_where_the_device_can(as_gpu, queue, there):
    among, poses, ranges = there(np.zeros(3 * COUNT + 1)), there(cloud(1)), there(mixed(1))
    late, model = among[1:].reshape(COUNT, 3), FIELD(GRID, NEAR, backend=queue)
    for given in ((late, ranges), (poses, there(np.zeros(BEAMS + 1))[1:])):
        with pytest.raises(ValueError, match=r"must begin at a multiple of \d+ bytes of its buffer .*: pass a copy"):
            model.bind(*given)
