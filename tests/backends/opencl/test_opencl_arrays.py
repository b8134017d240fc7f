"""Arrays of pyopencl on a user's queue stay in place, and results are such arrays."""

from __future__ import annotations

import dataclasses
import gc
import re
from typing import Any

import numpy as np
import pytest
from support.scan_calls import BEAM, BEAMS, COUNT, FIELD, GRID, MODELS, NEAR, SCANNER, cloud, mixed, scan

import gpusense as gs
from gpusense.backends import get_backend, proof, selection
from gpusense.evaluation.tolerances import differing
from gpusense.models import chunking

METHODS = ("log_likelihood", "field", "expected_ranges", "cast", "cones", "absolute", "landmarks")


def call_of(method: str, backend: Any) -> Any:
    """Return the call that takes poses and ``out=``."""
    if method == "cast":
        caster = gs.RayCaster(GRID, 5.0, backend=backend)
        return lambda poses, **options: caster.cast(poses, SCANNER.bearings, **options)
    if method == "absolute":
        heading = gs.HeadingModel(backend=backend)
        return lambda poses, **options: heading.log_likelihood(poses, 0.3, **options)
    if method == "landmarks":
        map_ = gs.LandmarkMap(np.random.default_rng(1).uniform(0, 6, (9, 2)))
        landmarks = gs.LandmarkModel(map_, backend=backend)
        features = [[1.0, 0.1], [2.0, 0.4]]
        return lambda poses, **options: landmarks.log_likelihood(poses, features, **options)
    scanner = gs.Scanner(np.linspace(-3, 3, 7), 5.0, cone=0.3, cone_rays=3) if method == "cones" else SCANNER
    model = (FIELD if method == "field" else BEAM)(GRID, scanner, backend=backend)
    if method in ("expected_ranges", "cones"):
        return model.expected_ranges
    return lambda poses, **options: model.log_likelihood(poses, scan(1), **options)


@pytest.mark.sampled(0.25)
@pytest.mark.parametrize("real", [np.float32, np.float64])
@pytest.mark.parametrize("method", METHODS)
def test_poses_on_the_device_stay_there(method, real, queue, there, copies):
    """Results have the bits of results for NumPy's poses, and are arrays on the queue; out= is filled in place."""
    call, poses = call_of(method, queue), cloud(1).astype(real)
    expected, given = call(poses), there(poses)
    call(given)
    copies.clear()
    found = call(given)
    assert type(found) is type(given) and found.queue == queue and found.shape == expected.shape
    assert differing(found.get(), expected) == 0
    assert [size for way, size in copies if way == "down"] == [8]
    assert all(size < poses.nbytes for _, size in copies)
    out = there(np.full_like(expected, 7))
    assert call(given, out=out) is out and differing(out.get(), expected) == 0


@pytest.mark.parametrize("share", [True, False], ids=["together", "apart"])
@pytest.mark.parametrize("kind", MODELS)
def test_several_scans(kind, share, queue, there, monkeypatch):
    """Scans and pieces may begin where the device cannot begin a sub-buffer."""
    model = kind(GRID, SCANNER, backend=queue)
    monkeypatch.setattr(
        "gpusense.models.scan.pipeline.TOGETHER", {"gpu": 1 << 22 if share else 0} | {"cpu": 1 << 22 if share else 0}
    )
    for count in (COUNT, 129, 256):
        poses = np.stack([cloud(i, count) for i in range(4)]).astype(np.float32)
        scans = np.stack([scan(1), np.full(BEAMS, np.nan), scan(2), scan(3, 20)])
        expected = model.log_likelihood(poses, scans)
        assert (model._last.together > 1) == share
        assert differing(model.log_likelihood(there(poses), there(scans)).get(), expected) == 0
        out = there(np.zeros((4, count), np.float32))
        # Poses at any offset in their buffer are copied.
        among = there(np.concatenate([np.zeros(5, np.float32), poses.ravel()]))[5:].reshape(4, count, 3)
        assert among.offset == 20
        assert model.log_likelihood(among, scans, out=out) is out and differing(out.get(), expected) == 0


@pytest.mark.sampled(1)
@pytest.mark.parametrize("kind", MODELS)
def test_pieces_with_which_the_device_cannot_begin(kind, as_gpu, queue, there, monkeypatch):
    """Such pieces are written elsewhere and copied; bound calls copy nothing and use larger pieces."""
    monkeypatch.setattr(chunking, "CHUNK", 49)
    poses = cloud(3, 300).astype(np.float32)
    model, caster = kind(GRID, NEAR, backend=queue, precision="float64"), gs.RayCaster(GRID, 5.0, backend=queue)
    heading = gs.HeadingModel(backend=queue)
    given, ranges = there(poses), there(mixed(1))
    for _ in range(2):
        expected = model.log_likelihood(poses, mixed(1))
        assert differing(model.log_likelihood(given, mixed(1)).get(), expected) == 0
        assert differing(caster.cast(given, [0.1, 0.2, 0.3]).get(), caster.cast(poses, [0.1, 0.2, 0.3])) == 0
        assert differing(heading.log_likelihood(given, 0.3).get(), heading.log_likelihood(poses, 0.3)) == 0
    call = model.bind(given, ranges)
    for seed in (4, 5):
        given.set(cloud(seed, 300).astype(np.float32))
        expected = model.log_likelihood(given, mixed(1)).get()
        assert differing(call().get(), expected) == 0


def test_parts_of_parts(queue, there, monkeypatch):
    """An array that begins within a buffer, or is a sub-buffer itself, has no sub-buffers."""
    import pyopencl as cl
    import pyopencl.array

    monkeypatch.setattr("gpusense.models.scan.pipeline.TOGETHER", dict.fromkeys(("gpu", "cpu"), 0))
    model, poses = FIELD(GRID, SCANNER, backend=queue), np.stack([cloud(i, 256) for i in range(3)])
    scans = np.stack([scan(1), scan(2), np.full(BEAMS, np.nan)])
    expected = model.log_likelihood(poses, scans)
    given, room = there(np.concatenate([np.zeros((2, 256, 3)), poses]))[2:], there(np.zeros((5, 256), np.float32))
    whole = cl.Buffer(queue.context, cl.mem_flags.READ_WRITE, 8192 + poses.nbytes)
    own = pyopencl.array.Array(queue, poses.shape, np.float64, data=whole.get_sub_region(8192, poses.nbytes))
    own.set(poses)
    for one in (given, own):
        assert differing(model.log_likelihood(one, scans).get(), expected) == 0
        assert model.log_likelihood(one, scans, out=room[2:]) is not None
        assert differing(room[2:].get(), expected) == 0


def test_arrays_of_a_memory_pool(as_gpu, queue, monkeypatch):
    """Their buffers have another class."""
    import pyopencl.array
    import pyopencl.tools

    pool = pyopencl.tools.MemoryPool(pyopencl.tools.ImmediateAllocator(queue))
    model, poses = FIELD(GRID, NEAR, backend=queue), np.stack([cloud(1, 256), cloud(2, 256)])
    monkeypatch.setattr("gpusense.models.scan.pipeline.TOGETHER", dict.fromkeys(("gpu", "cpu"), 0))
    scans = np.stack([mixed(1), mixed(2)])
    given = pyopencl.array.to_device(queue, poses, allocator=pool)
    assert differing(model.log_likelihood(given, scans).get(), model.log_likelihood(poses, scans)) == 0
    one, ranges = given[1], pyopencl.array.to_device(queue, mixed(2), allocator=pool)
    assert differing(model.bind(one, ranges)().get(), model.log_likelihood(one, mixed(2)).get()) == 0


@pytest.mark.parametrize("kind", MODELS)
def test_ordinary_calls_whose_arrays_repeat_copy_none(kind, as_gpu, queue, there, monkeypatch):
    """Arrays that are freed meanwhile, and whose places others take, change no result."""
    model, plain = (kind(GRID, NEAR, backend=queue) for _ in range(2))
    plain._short = None
    poses, ranges, out = there(cloud(0)), there(mixed(0)), there(np.zeros(COUNT, np.float32))
    copied, copy = [], as_gpu.copy
    monkeypatch.setattr(as_gpu, "copy", lambda *given, **how: (copied.append(given), copy(*given, **how)))
    for seed in range(6):
        poses.set(cloud(seed))
        ranges.set(mixed(seed))
        copied.clear()
        assert model.log_likelihood(poses, ranges, out=out) is out
        assert differing(out.get(), plain.log_likelihood(poses, mixed(seed)).get()) == 0
    assert model._short.last is not None and not copied
    del poses, ranges
    for seed in range(12):
        given = there(cloud(seed)), there(mixed(seed))
        found = model.log_likelihood(*given)
        assert differing(found.get(), plain.log_likelihood(*given).get()) == 0
        del given
        gc.collect()


def test_arrays_in_shared_virtual_memory(queue):
    import pyopencl as cl
    import pyopencl.array
    import pyopencl.tools

    try:
        allocator = pyopencl.tools.SVMAllocator(queue.context, queue=queue, flags=cl.svm_mem_flags.READ_WRITE)
        given = pyopencl.array.to_device(queue, cloud(1), allocator=allocator)
    except cl.Error:
        pytest.skip("the device has none")
    with pytest.raises(TypeError, match="poses: must be in a buffer, got an array in shared virtual memory"):
        FIELD(GRID, SCANNER, backend=queue).log_likelihood(given, scan(1))


def test_other_processes_are_refused(as_gpu, queue, there, monkeypatch):
    """A forked child has another process number, and drivers do not work there."""
    call = FIELD(GRID, NEAR, backend=queue).bind(there(cloud(1)), there(mixed(1)))
    call()
    call.check()
    monkeypatch.setattr(as_gpu, "_process", -1)
    # The child looks up selection strings again.
    monkeypatch.setattr(selection, "_looks", ((), {}))
    for refused in (call, call.check, lambda: get_backend(queue), lambda: get_backend("opencl")):
        with pytest.raises(RuntimeError, match="does not survive a fork"):
            refused()


@pytest.mark.parametrize("kind", MODELS)
def test_an_error_leaves_no_verdict_behind(kind, queue, there, monkeypatch):
    """A call that ended early with a pose that is not finite does not affect the next call."""
    model, poses = kind(GRID, SCANNER, backend=queue), cloud(1)
    expected = model.log_likelihood(there(poses), scan(1)).get()
    bad = poses.copy()
    bad[3] = np.nan
    several = gs.log_likelihoods

    def ends(*_: object) -> None:
        raise KeyboardInterrupt

    for call in (lambda: model.log_likelihood(there(bad), scan(1)), lambda: several([model], there(bad), [scan(1)])):
        with monkeypatch.context() as patch:
            for name in ("read", "wait"):
                patch.setattr(model._workspace, name, ends)
            with pytest.raises(KeyboardInterrupt):
                call()
        assert differing(model.log_likelihood(there(poses), scan(1)).get(), expected) == 0


def test_a_device_without_float64_places_no_poses(as_gpu, queue, there, monkeypatch):
    monkeypatch.setattr(as_gpu, "info", dataclasses.replace(as_gpu.info, float64=False))
    for call in (call_of("field", queue), call_of("absolute", queue)):
        with pytest.raises(TypeError, match=r"poses: must be in host memory on .*, which has no float64"):
            call(there(cloud(1)))


def test_writes_of_another_queue_are_waited_for(queue, there):
    """The device waits before any launch that reads the array."""
    import pyopencl as cl

    model, poses = FIELD(GRID, SCANNER, backend=queue), there(cloud(1))

    class Busy:
        """Writes poses when it is waited for."""

        def finish(self) -> None:
            cl.enqueue_copy(queue, poses.base_data, cloud(2))

    expected = model.log_likelihood(cloud(2), scan(1))
    poses.queue = Busy()
    assert differing(model.log_likelihood(poses, scan(1)).get(), expected) == 0
    # The same for arrays with events on their queue.
    moved = there(cloud(1)).with_queue(cl.CommandQueue(queue.context))
    moved += 0.25
    assert moved.events
    assert differing(model.log_likelihood(moved, scan(1)).get(), model.log_likelihood(cloud(1) + 0.25, scan(1))) == 0


def test_a_pose_that_is_not_finite(queue, there):
    model, poses = BEAM(GRID, SCANNER, backend=queue), cloud(1)
    poses[7, 1] = np.inf
    for _ in range(2):
        with pytest.raises(ValueError, match="poses: must be finite, got a pose on the device that is not"):
            model.log_likelihood(there(poses), scan(1))
    poses[7, 1] = 1.0
    assert differing(model.log_likelihood(there(poses), scan(1)).get(), model.log_likelihood(poses, scan(1))) == 0


# ---- what cannot be used


def test_backends_of_queues(queue):
    """A queue keeps one backend while it is referenced."""
    import pyopencl as cl

    device = get_backend(queue)
    assert get_backend(queue) is device and FIELD(GRID, NEAR, backend=queue)._context.backend is device
    assert device.info == get_backend(device.info.selection).info
    other = cl.CommandQueue(queue.context)
    assert get_backend(other) is not device
    del device
    gc.collect()
    assert queue.int_ptr not in selection._BACKENDS_OF_QUEUES
    properties = cl.command_queue_properties.OUT_OF_ORDER_EXEC_MODE_ENABLE
    with pytest.raises(ValueError, match="backend: must be an in-order queue"):
        get_backend(cl.CommandQueue(queue.context, properties=properties))
    for wrong in (queue.context, 3, None):
        with pytest.raises(TypeError, match="backend: must be a selection string or a queue of pyopencl, got"):
            get_backend(wrong)


def test_a_queue_of_an_unusable_device_is_refused_with_the_reason(queue, monkeypatch):
    """Devices of queues are proved like devices of selection strings."""
    import pyopencl as cl

    info, another = get_backend(queue).info, cl.CommandQueue(queue.context)
    verdict = proof.unusable("scalar kernels compute wrong ranges")
    monkeypatch.setattr(proof, "verdict_on", lambda *arguments, **options: verdict)
    message = f"{info.selection} ({info.name}, {info.driver}) is unusable: {proof.with_remedy(verdict.reason)}"
    for make in (get_backend, lambda backend: FIELD(GRID, NEAR, backend=backend)):
        with pytest.raises(ValueError, match=f"^backend: {re.escape(message)}, got a queue of it$"):
            make(another)
    assert another.int_ptr not in selection._BACKENDS_OF_QUEUES
    monkeypatch.undo()
    assert get_backend(another).info == info


WRONG = {
    "integers": (lambda there: there(np.zeros((5, 3), np.int32)), TypeError, "poses: must hold float32 or float64"),
    "complex": (lambda there: there(np.zeros((5, 3), np.complex64)), TypeError, "poses: must hold real numbers, got"),
    "a shape": (lambda there: there(np.zeros((5, 2))), ValueError, "poses: shape must be (N, 3), got (5, 2)"),
    "bytes": (lambda there: there(np.zeros((5, 3), ">f8")), TypeError, "poses: must hold float32 or float64, got"),
    "columns": (lambda there: there(np.zeros((3, 5))).T, ValueError, "poses: must be C-contiguous on the device, got"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_poses_that_cannot_be_used(name, queue, there):
    make, error, message = WRONG[name]
    with pytest.raises(error, match=r"^" + re.escape(message)):
        FIELD(GRID, SCANNER, backend=queue).log_likelihood(make(there), scan(1))


def test_results_that_cannot_be_written(queue, there):
    model, poses = FIELD(GRID, SCANNER, backend=queue), there(cloud(1))
    among = there(np.zeros(COUNT + 1, np.float32))[1:]
    for out, error, message in (
        (there(np.zeros(COUNT)), TypeError, "out: must hold float32, got float64"),
        (there(np.zeros(3, np.float32)), ValueError, f"out: shape must be ({COUNT},), got (3,)"),
        (np.zeros(COUNT, np.float32), TypeError, "out: must be in the memory where the poses are"),
        (among, ValueError, "out: must begin at a multiple of "),
        (there(np.zeros(2 * COUNT, np.float32))[::2], ValueError, "out: must be C-contiguous and writable"),
    ):
        with pytest.raises(error, match=r"^" + re.escape(message)):
            model.log_likelihood(poses, scan(1), out=out)


def test_arrays_of_other_places(queue, there, needs):
    """Each message names the remedy."""
    for name in ("numpy", needs("warp"), needs("opencl")):
        expected = "must be of the context of" if name.startswith("opencl") else "must be in host memory for"
        with pytest.raises(TypeError, match=rf"^poses: {expected} .*backend=<the array's queue>"):
            FIELD(GRID, SCANNER, backend=name).log_likelihood(there(cloud(1)), scan(1))
    with pytest.raises(TypeError, match=r"^ranges: must be in host memory for numpy"):
        FIELD(GRID, SCANNER, backend="numpy").log_likelihood(cloud(1), there(scan(1)))


def test_readings_with_gaps(queue, there):
    """Readings are copied to the host, including gaps."""
    model = FIELD(GRID, SCANNER, backend=queue)
    twice = np.repeat(scan(1), 2)
    twice[1::2] = np.nan
    found = model.log_likelihood(there(cloud(1)), there(twice)[::2])
    assert differing(found.get(), model.log_likelihood(cloud(1), scan(1))) == 0
