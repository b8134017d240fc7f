"""Arrays on a device: Warp's processor replaces a GPU; real frameworks on a real GPU."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from support.array_calls import METHODS, result_call
from support.array_libraries import Array, to_device
from support.selection import skip_or_fail

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.backends.workspace import Workspace
from gpusense.evaluation.tolerances import differing
from gpusense.models import chunking


def framework(name: str) -> tuple[Any, ...]:
    """Return a GPU's backend, and functions that make an array there, copy it back, and return its address."""
    module = pytest.importorskip(name)
    cuda = next((d.selection for d in gs.devices() if d.available and d.selection.startswith("warp:cuda")), None)
    if cuda is None:
        skip_or_fail("cuda", "there is no CUDA device")
    if name == "torch":
        return (cuda, lambda array: module.from_numpy(array.copy()).to(cuda.removeprefix("warp:")),
                lambda array: array.cpu().numpy(), lambda array: array.data_ptr())  # fmt: skip
    if name == "cupy":
        return cuda, module.asarray, module.asnumpy, lambda array: array.data.ptr
    module.config.update("jax_enable_x64", True)
    return (cuda, lambda array: module.device_put(array, module.devices("gpu")[0]), np.asarray,
            lambda array: array.unsafe_buffer_pointer())  # fmt: skip


each_framework = pytest.mark.parametrize("name", ["torch", "cupy", "jax"])


BEAMS, COUNT, RANGE = 21, 300, 5.0
RNG = np.random.default_rng(12)
GRID = gs.OccupancyGrid(np.where(RNG.random((60, 70)) < 0.04, 100, 0).astype(np.int8), 0.1)
SCANNER = gs.Scanner(np.linspace(-3, 3, BEAMS), RANGE, mount=(0.1, 0.0, 0.2))
POSES = np.column_stack([RNG.uniform(-1, 7, (COUNT, 2)), RNG.uniform(-4, 4, COUNT)])
SCAN = RNG.uniform(0, 5.5, BEAMS)
# Bytes of up to three arrays of a scan that are copied as one, each at a multiple of 256.
FEW = 3 * 256


def call_of(method: str, backend, scan=SCAN):
    """Return the call that takes poses and ``out=``, and the shape of its result."""
    call, shape = result_call(method, backend, GRID, SCANNER, scan)
    return call, (COUNT, *shape)


@pytest.mark.sampled(0.4)
@pytest.mark.parametrize("real", [np.float32, np.float64])
@pytest.mark.parametrize("method", METHODS)
def test_poses_on_the_device_stay_there(method, real, warp_as_gpu, warp_copies):
    call, shape = call_of(method, warp_as_gpu)
    poses = POSES.astype(real)
    expected = call(poses)
    for given in (to_device(poses), Array(to_device(poses))):
        call(given)
        warp_copies.clear()
        found = call(given)
        held = found.held if isinstance(given, Array) else found
        assert type(found) is type(given) and tuple(held.shape) == shape
        assert differing(held.numpy(), expected) == 0
        # Only rays and readings go to the device, and only the two numbers of the pose status come back.
        assert all(size <= FEW for _, size in warp_copies)
        assert [size for way, size in warp_copies if way == "down"] == [8]


@pytest.mark.parametrize("method", METHODS)
def test_out_on_the_device(method, warp_as_gpu, warp_copies):
    call, shape = call_of(method, warp_as_gpu)
    expected, poses = call(POSES), to_device(POSES)
    for wrap in (lambda array: array, Array):
        room = to_device(np.full(shape, 7, np.float32))
        out, address = wrap(room), room.ptr
        warp_copies.clear()
        assert call(wrap(poses), out=out) is out
        assert room.ptr == address and differing(room.numpy(), expected) == 0
        assert all(size <= FEW or size == 4 * 8192 for way, size in warp_copies)


@pytest.mark.parametrize("selection", ["opencl", "warp"])
def test_copies_on_the_device(selection, needs):
    """Copy between any two places, after all earlier commands."""
    backend, real = get_backend(needs(selection)), np.dtype(np.float32)
    source, target = backend.empty_external(8, real), backend.empty_external(6, real)
    backend.upload(np.arange(8, dtype=real), source)
    backend.upload(np.full(6, 77, real), target)
    backend.copy(source, target, 12, begin=8, to=4)
    backend.copy(source, target, 0)
    found = backend.download(target, np.empty(6, real))
    backend.synchronize()
    assert found.tolist() == [77, 2, 3, 4, 77, 77]


@pytest.mark.parametrize("real", [np.float32, np.float64])
@pytest.mark.parametrize("kind", [gs.BeamModel, gs.LikelihoodFieldModel])
def test_scans_that_share_launches_on_the_device(kind, real, warp_as_gpu, warp_copies):
    model = kind(GRID, SCANNER, backend=warp_as_gpu)
    several = np.stack([POSES + 0.1 * i for i in range(5)]).astype(real)
    scans = np.stack([SCAN, SCAN[::-1], np.full(BEAMS, np.nan), np.roll(SCAN, 3), np.where(SCAN < 2, np.inf, SCAN)])
    expected = np.stack([model.log_likelihood(own, scan) for own, scan in zip(several, scans, strict=True)])
    out = to_device(np.zeros((5, COUNT), np.float32))
    for given in (to_device(several), Array(to_device(several))):
        warp_copies.clear()
        found = model.log_likelihood(given, scans)
        assert type(found) is type(given) and model._last.together == 2
        assert differing((found.held if isinstance(found, Array) else found).numpy(), expected) == 0
        # Poses stay on the device; the scan without readings is filled in.
        assert all(size <= 5 * 16 * BEAMS for way, size in warp_copies) and ("up", 24 * COUNT) not in warp_copies
        assert [size for way, size in warp_copies if way == "down"] == [8]
        assert model.log_likelihood(given, scans, out=out) is out and differing(out.numpy(), expected) == 0
    for scan, place in ((2, 5), (3, 7), (4, COUNT - 1)):
        bad = several.copy()
        bad[scan, place, 1] = np.nan
        with pytest.raises(ValueError, match="poses: must be finite, got a pose on the device that is not"):
            model.log_likelihood(to_device(bad), scans)
        assert differing(model.log_likelihood(to_device(several), scans).numpy(), expected) == 0
    for wrong in (several[:4], several[..., :2], several[0]):
        with pytest.raises(ValueError, match=r"^poses: shape must be \(5, N, 3\), got \("):
            model.log_likelihood(to_device(np.ascontiguousarray(wrong)), scans)
    with pytest.raises(TypeError, match="poses: must hold float32 or float64, got int32"):
        model.log_likelihood(to_device(np.zeros((5, 4, 3), np.int32)), scans)
    with pytest.raises(ValueError, match="poses: must be C-contiguous on the device, got strides"):
        model.log_likelihood(to_device(several)[:, ::2], scans)


@pytest.mark.parametrize("method", METHODS)
def test_in_pieces_on_the_device(method, warp_as_gpu, monkeypatch):
    call, _ = call_of(method, warp_as_gpu)
    expected = call(POSES)
    monkeypatch.setattr(chunking, "CHUNK", 77)
    assert differing(call(to_device(POSES)).numpy(), expected) == 0


@pytest.mark.parametrize("count", [COUNT, 0])
@pytest.mark.parametrize("where", [to_device, np.array], ids=["device", "host"])
def test_no_array_of_a_call_is_kept(where, count, warp_as_gpu):
    """A scan's arrays live exactly until the device has read them, since filters run for hours."""
    model, caster = gs.BeamModel(GRID, SCANNER, backend=warp_as_gpu), gs.RayCaster(GRID, RANGE, backend=warp_as_gpu)
    for scan in (SCAN, np.full(BEAMS, np.nan)):
        model.log_likelihood(where(POSES[:count]), scan)
        caster.cast(where(POSES[:count]), SCANNER.bearings)
        assert model._workspace._busy == [] and caster._caster._workspace._busy == []


@pytest.mark.parametrize("scan", [SCAN, np.full(BEAMS, np.nan)], ids=["readings", "no reading"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_pose_on_the_device_that_is_not_finite(value, scan, warp_as_gpu):
    message = "^poses: must be finite, got a pose on the device that is not$"
    for method in METHODS:
        if method in ("expected_ranges", "cast") and scan is not SCAN:
            continue
        call, _ = call_of(method, warp_as_gpu, scan)
        bad = POSES.copy()
        bad[17, 1] = value
        expected = call(POSES)
        with pytest.raises(ValueError, match=message):
            call(to_device(bad))
        # The error is reported once.
        assert differing(call(to_device(POSES)).numpy(), expected) == 0


def test_a_pose_that_is_not_finite_is_reported_after_memory_ran_out(warp_as_gpu, monkeypatch):
    """The first piece has the pose; the second is retried in halves."""
    model = gs.BeamModel(GRID, SCANNER, backend=warp_as_gpu)
    poses = np.tile(POSES, (6, 1))
    poses[3, 0] = np.nan
    monkeypatch.setattr(chunking, "CHUNK", 600)
    model._pipeline._most.clear()
    before, calls = Workspace.empty, []

    def empty(self, name, count, dtype, *, zero=False):
        calls.append(name)
        if calls.count("parts") == 2 and name == "parts":
            raise MemoryError("none left")
        return before(self, name, count, dtype, zero=zero)

    monkeypatch.setattr(Workspace, "empty", empty)
    with pytest.raises(ValueError, match="poses: must be finite"):
        model.log_likelihood(to_device(poses), SCAN)
    assert calls.count("parts") >= 4


ON_DEVICE_WRONG = {
    "a shape": (lambda: to_device(POSES[:, :2].copy()), ValueError, f"poses: shape must be (N, 3), got ({COUNT}, 2)"),
    "an axis": (lambda: to_device(POSES[0]), ValueError, "poses: shape must be (N, 3), got (3,)"),
    "integers": (lambda: to_device(np.zeros((4, 3), np.int32)), TypeError,
                 "poses: must hold float32 or float64, got int32"),
    "strides": (lambda: to_device(POSES)[::2], ValueError, "poses: must be C-contiguous on the device, got strides"),
}  # fmt: skip


@pytest.mark.parametrize("name", ON_DEVICE_WRONG)
@pytest.mark.parametrize("method", METHODS)
def test_poses_on_the_device_that_cannot_be_used(method, name, warp_as_gpu):
    make, error, message = ON_DEVICE_WRONG[name]
    call, _ = call_of(method, warp_as_gpu)
    with pytest.raises(error, match="^" + re.escape(message)):
        call(make())


OUT_WRONG = {
    "on the host": (lambda shape: np.empty(shape, np.float32), TypeError,
                    "out: must be in the memory where the poses are, got one that is not"),
    "a precision": (lambda shape: to_device(np.empty(shape)), TypeError, "out: must hold float32, got float64"),
    "strides": (lambda shape: to_device(np.empty((2 * shape[0], *shape[1:]), np.float32))[::2], ValueError,
                "out: must be C-contiguous and writable, got one that is not"),
    "a shape": (lambda shape: to_device(np.empty((3, *shape), np.float32)), ValueError, "out: shape must be ("),
}  # fmt: skip


@pytest.mark.parametrize("name", OUT_WRONG)
@pytest.mark.parametrize("method", METHODS)
def test_out_on_the_device_that_cannot_be_written(method, name, warp_as_gpu):
    make, error, message = OUT_WRONG[name]
    call, shape = call_of(method, warp_as_gpu)
    with pytest.raises(error, match="^" + re.escape(message)):
        call(to_device(POSES), out=make(shape))


# ---- frameworks on a real GPU


@each_framework
@pytest.mark.parametrize("real", [np.float32, np.float64])
@pytest.mark.parametrize("method", METHODS)
def test_frameworks(method, real, name):
    cuda, there, back, _ = framework(name)
    call, shape = call_of(method, cuda)
    poses = POSES.astype(real)
    given = there(poses)
    found = call(given)
    assert type(found) is type(given) and tuple(found.shape) == shape
    assert differing(back(found), call(poses)) == 0
    bad = poses.copy()
    bad[5, 2] = np.nan
    with pytest.raises(ValueError, match="poses: must be finite"):
        call(there(bad))
    with pytest.raises(TypeError, match="poses: must be in host memory for numpy"):
        call_of(method, "numpy")[0](given)


@pytest.mark.parametrize("name", ["torch", "cupy"])
@pytest.mark.parametrize("method", METHODS)
def test_frameworks_that_may_be_written(method, name, needs):
    cuda, there, back, address = framework(name)
    call, shape = call_of(method, cuda)
    out = there(np.full(shape, 7, np.float32))
    place = address(out)
    assert call(there(POSES), out=out) is out
    assert address(out) == place and differing(back(out), call(POSES)) == 0
    with pytest.raises(ValueError, match="poses: must be C-contiguous on the device"):
        call(there(np.repeat(POSES, 2, axis=0))[::2])
    with pytest.raises(TypeError, match="poses: must be in host memory for opencl"):
        call_of(method, needs("opencl"))[0](there(POSES))
    assert get_backend(cuda).info.kind == "gpu"
