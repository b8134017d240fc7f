"""Arrays of other libraries in host memory, and ``out=``: no copy, the same library back, and writable arrays only."""

from __future__ import annotations

import re
import types

import numpy as np
import pytest
from support.array_calls import METHODS, result_call
from support.array_libraries import CUDA, Array, OldArray, Recorded, installed

import gpusense as gs
from gpusense.backends import arrays, get_backend
from gpusense.backends.workspace import Workspace
from gpusense.evaluation.tolerances import differing

BEAMS, COUNT, RANGE = 21, 40, 5.0
RNG = np.random.default_rng(12)
GRID = gs.OccupancyGrid(np.where(RNG.random((60, 70)) < 0.04, 100, 0).astype(np.int8), 0.1)
SCANNER = gs.Scanner(np.linspace(-3, 3, BEAMS), RANGE)
POSES = np.column_stack([RNG.uniform(0, 6, (COUNT, 2)), RNG.uniform(-4, 4, COUNT)])
SCAN = RNG.uniform(0, 5.5, BEAMS)


@pytest.fixture(autouse=True)
def fakelib(monkeypatch):
    installed(monkeypatch)


def call_of(method: str, backend, scan=SCAN):
    """Return the call that takes poses and ``out=``, and the shape of its result."""
    call, shape = result_call(method, backend, GRID, SCANNER, scan)
    return call, (COUNT, *shape)


# ---- in


@pytest.mark.sampled(0.4)
@pytest.mark.parametrize("method", METHODS)
def test_results_come_back_in_the_library_of_the_poses(method, backend):
    call, shape = call_of(method, backend)
    expected = call(POSES)
    found = call(Array(POSES))
    assert type(found) is Array and found.shape == shape
    assert differing(found.held, expected) == 0
    for given in (POSES.tolist(), POSES, np.asfortranarray(POSES), POSES[::-1][::-1]):
        assert type(call(given)) is np.ndarray
        assert differing(call(given), expected) == 0


@pytest.mark.parametrize("method", METHODS)
def test_warp_arrays_of_the_processor(method, backend, needs):
    needs("warp")
    import warp as wp

    call, shape = call_of(method, backend)
    given = wp.array(POSES, dtype=wp.float64, device="cpu")
    found = call(given)
    assert isinstance(found, wp.array) and tuple(found.shape) == shape
    assert differing(found.numpy(), call(POSES)) == 0
    out = wp.zeros(shape, dtype=wp.float32, device="cpu")
    assert call(given, out=out) is out
    assert differing(out.numpy(), call(POSES)) == 0


@pytest.mark.parametrize("method", METHODS)
def test_float32_poses_are_the_numbers_they_are(method, backend):
    call, _ = call_of(method, backend)
    single = POSES.astype(np.float32)
    assert differing(call(Array(single)).held, call(single.astype(np.float64))) == 0


def test_arrays_whose_gradients_are_recorded_are_refused_with_the_remedy():
    model = gs.BeamModel(GRID, SCANNER, backend="numpy")
    poses, scan, out = Recorded(POSES), Recorded(SCAN), Recorded(np.empty(COUNT, np.float32))
    several = Recorded(np.stack([POSES, POSES]))
    for name, call in (
        ("poses", lambda: model.log_likelihood(poses, SCAN)),
        ("poses", lambda: model.expected_ranges(poses)),
        ("poses", lambda: model.log_likelihood(several, [SCAN, SCAN])),
        ("ranges", lambda: model.log_likelihood(POSES, scan)),
        ("out", lambda: model.log_likelihood(POSES, SCAN, out=out)),
    ):
        message = f"{name}: must not require gradients, .*, got a fakelib.Recorded that does: pass {name}.detach()"
        with pytest.raises(TypeError, match=re.escape(message).replace(re.escape(".*"), ".*")):
            call()
    found = model.log_likelihood(poses.detach(), scan.detach())
    assert differing(found.held, model.log_likelihood(POSES, SCAN)) == 0


def test_a_batch_of_another_library(backend):
    model = gs.BeamModel(GRID, SCANNER, backend=backend)
    several, scans = np.stack([POSES, POSES + 0.1]), np.stack([SCAN, SCAN[::-1]])
    found = model.log_likelihood(Array(several), Array(scans))
    assert type(found) is Array and found.shape == (2, COUNT)
    assert differing(found.held, model.log_likelihood(several, scans)) == 0
    assert model.log_likelihood(np.empty((0, 7, 3)), np.empty((0, BEAMS))).shape == (0, 7)


@pytest.mark.parametrize("wrap", [lambda array: array, Array])
@pytest.mark.parametrize("method", METHODS)
def test_arrays_that_can_be_used_as_they_are_are_not_copied(method, wrap, backend, monkeypatch):
    """Poses are read in place, and results are written in place."""
    call, shape = call_of(method, backend)
    seen, before = {}, Workspace.upload

    def upload(self, name, array):
        seen[name] = array.ctypes.data
        return before(self, name, array)

    monkeypatch.setattr(Workspace, "upload", upload)
    out = np.empty(shape, np.float32)
    call(wrap(POSES), out=out)
    assert seen["poses"] == POSES.ctypes.data
    for other in (POSES.astype(np.float32), np.asfortranarray(POSES), np.repeat(POSES, 2, axis=0)[::2]):
        call(wrap(other), out=out)
        assert seen["poses"] != other.ctypes.data


# ---- out


@pytest.mark.parametrize("method", METHODS)
def test_out_is_filled_and_returned(method, backend):
    call, shape = call_of(method, backend)
    expected = call(POSES)
    for wrap in (lambda array: array, Array, OldArray):
        room = np.full(shape, 7, np.float32)
        out = wrap(room)
        assert call(POSES, out=out) is out
        assert differing(room, expected) == 0
        room[...] = 7
        assert call(Array(POSES), out=out) is out
        assert differing(room, expected) == 0


def test_out_of_scans_without_a_reading_and_without_particles(backend):
    call, _ = call_of("log_likelihood", backend, np.full(BEAMS, np.nan))
    out = np.full(COUNT, 7, np.float32)
    assert call(POSES, out=out) is out
    assert (out == 0).all()
    none = np.empty(0, np.float32)
    assert call(np.empty((0, 3)), out=none) is none


def read_only(shape, dtype):
    room = np.empty(shape, dtype)
    room.flags.writeable = False
    return room


WRONG = {
    "a shape": (lambda shape: np.empty((*shape[:-1], shape[-1] + 1), np.float32), ValueError,
                lambda shape: f"out: shape must be {arrays.shape_text(shape)}, got "
                              f"{arrays.shape_text((*shape[:-1], shape[-1] + 1))}"),
    "axes": (lambda shape: np.empty((1, *shape), np.float32), ValueError,
             lambda shape: f"out: shape must be {arrays.shape_text(shape)}, got {arrays.shape_text((1, *shape))}"),
    "a precision": (lambda shape: np.empty(shape), TypeError, lambda shape: "out: must hold float32, got float64"),
    "strides": (lambda shape: np.empty((*shape, 2), np.float32)[..., 0], ValueError,
                lambda shape: "out: must be C-contiguous and writable, got one that is not"),
    "read-only": (lambda shape: read_only(shape, np.float32), ValueError,
                  lambda shape: "out: must be C-contiguous and writable, got one that is not"),
    "old and read-only": (lambda shape: OldArray(read_only(shape, np.float32)), TypeError,
                          lambda shape: "out: must be an array, got "),
    "a list": (lambda shape: [0.0], TypeError, lambda shape: "out: must be an array, got [0.0]"),
    "a number": (lambda shape: 3, TypeError, lambda shape: "out: must be an array, got 3"),
    "on a device": (lambda shape: Array(np.empty(shape, np.float32), CUDA), TypeError,
                    lambda shape: "out: must be in the memory where the poses are, got one that is not"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
@pytest.mark.parametrize("method", METHODS)
def test_out_that_cannot_be_written(method, name, backend):
    call, shape = call_of(method, backend)
    make, error, message = WRONG[name]
    with pytest.raises(error, match="^" + re.escape(message(shape))):
        call(POSES, out=make(shape))


# ---- arrays on a device that the backend cannot read


@pytest.mark.parametrize("method", METHODS)
def test_poses_on_a_device_that_the_backend_cannot_read(method, backend):
    if backend.startswith("warp:cuda"):
        backend = "numpy"
    call, _ = call_of(method, backend)
    selection = get_backend(backend).info.selection
    message = (
        f"poses: must be in host memory for {selection}, or the model made with backend='warp:cuda:<n>', got a "
        "fakelib.Array on a device"
    )
    with pytest.raises(TypeError, match="^" + re.escape(message) + "$"):
        call(Array(POSES, CUDA))


@pytest.mark.parametrize("kind", [1, 3, 11])
def test_pinned_memory_is_host_memory(kind):
    assert not arrays.on_device(Array(POSES, kind))
    assert arrays.on_device(Array(POSES, CUDA))


def test_an_array_with_only_a_cuda_interface_is_on_a_device():
    class OnDevice:
        __cuda_array_interface__ = types.MappingProxyType({"shape": (1, 3), "typestr": "<f8", "data": (0, False)})

    assert arrays.on_device(OnDevice())
    with pytest.raises(TypeError, match=r"^poses: must be in host memory for numpy, .*OnDevice on a device$"):
        gs.RayCaster(GRID, RANGE, backend="numpy").cast(OnDevice(), [0.0])
