"""Addresses of arrays of PyTorch, CuPy, JAX and Warp, read without DLPack; made-up libraries on Warp's processor."""

from __future__ import annotations

import contextlib
import sys
import types
from typing import Any

import numpy as np
import pytest

from gpusense.backends import get_backend

NUMBERS = np.arange(12.0).reshape(4, 3)
SIDE_STREAM = 77


class Stream:
    """A current stream of Warp's device, which lists the streams that it waits for."""

    def __init__(self, handle: int = 5, *, is_blocking: bool = True) -> None:
        self.cuda_stream, self.is_blocking = handle, is_blocking
        self.waited: list[int] = []

    def wait_stream(self, other: int) -> None:
        self.waited.append(other)


class Library:
    """An array of a made-up library, whose ``facts`` are its attributes and methods; DLPack is refused."""

    def __init__(self, numbers: np.ndarray, **facts: Any) -> None:
        self.numbers = numbers
        for name, value in facts.items():
            setattr(self, name, value)

    def __dlpack__(self, **options: Any) -> Any:
        raise BufferError("by DLPack")

    def __dlpack_device__(self) -> tuple[int, int]:
        return 1, 0


def as_torch(numbers: np.ndarray, **facts: Any) -> Library:
    torch = sys.modules["torch"]
    usual = dict(
        shape=numbers.shape, dtype=f"torch.{numbers.dtype}", is_cuda=True, layout=torch.strided, requires_grad=False,
        is_neg=lambda: False, is_contiguous=lambda: numbers.flags.c_contiguous, get_device=lambda: 0,
        data_ptr=lambda: numbers.ctypes.data,
    )  # fmt: skip
    return torch.Tensor(numbers, **usual | facts)


def as_cupy(numbers: np.ndarray, **facts: Any) -> Library:
    usual = dict(
        shape=numbers.shape, dtype=numbers.dtype, flags=numbers.flags, device=types.SimpleNamespace(id=0),
        data=types.SimpleNamespace(ptr=numbers.ctypes.data),
    )  # fmt: skip
    return sys.modules["cupy"].ndarray(numbers, **usual | facts)


def as_jax(numbers: np.ndarray, **facts: Any) -> Library:
    ready: list[int] = []
    usual = dict(
        shape=numbers.shape, dtype=numbers.dtype, device=types.SimpleNamespace(local_hardware_id=0), ready=ready,
        block_until_ready=lambda: ready.append(1), __cuda_array_interface__={"data": (numbers.ctypes.data, True)},
    )  # fmt: skip
    return sys.modules["jaxlib"].Array(numbers, **usual | facts)


@pytest.fixture
def device(needs, monkeypatch):
    """Return a made-up CUDA device in the memory of Warp's processor, with the three libraries."""
    needs("warp")
    from gpusense.backends.warp import arrays

    arrays._torch_type.cache_clear()
    current = types.SimpleNamespace(handle=0)
    for name, kind in (("torch", "Tensor"), ("cupy", "ndarray"), ("jaxlib", "Array")):
        module = types.ModuleType(name)
        setattr(module, kind, type(kind, (Library,), {"__module__": name}))
        monkeypatch.setitem(sys.modules, name, module)
    torch, cupy = sys.modules["torch"], sys.modules["cupy"]
    torch.strided, torch.float32, torch.float64 = "strided", "torch.float32", "torch.float64"
    torch.cuda = types.SimpleNamespace(current_stream=lambda i: types.SimpleNamespace(cuda_stream=current.handle))
    torch._C = types.SimpleNamespace(_cuda_getCurrentRawStream=lambda i: current.handle)
    cupy.cuda = types.SimpleNamespace(
        runtime=types.SimpleNamespace(getDevice=lambda: 0),
        get_current_stream=lambda: types.SimpleNamespace(ptr=current.handle),
    )
    cupy.empty = lambda shape, dtype: as_cupy(np.full(shape, 7, dtype))
    monkeypatch.setattr(arrays, "stream_of", lambda alias, handle: handle)
    return types.SimpleNamespace(
        alias="cpu", ordinal=0, stream=Stream(), current=current, context_guard=contextlib.nullcontext()
    )


@pytest.mark.parametrize("real", [np.float32, np.float64])
@pytest.mark.parametrize("make", [as_torch, as_cupy, as_jax])
def test_arrays_are_read_in_place(make, real, device):
    from gpusense.backends.warp.arrays import adopted

    array = make(NUMBERS.astype(real))
    found = adopted(array, device, "poses")
    assert found.buffer.ptr == array.numbers.ctypes.data and found.owner is array
    assert (found.shape, found.dtype, found.strides) == ((4, 3), np.dtype(real), None)
    assert (found.to_host() == array.numbers).all()
    assert make is not as_jax or array.ready, "JAX may still be computing it"


@pytest.mark.parametrize(
    ("make", "facts"),
    [
        (as_torch, dict(is_cuda=False)),
        (as_torch, dict(layout="sparse")),
        (as_torch, dict(requires_grad=True)),
        (as_torch, dict(is_neg=lambda: True)),
        (as_torch, dict(is_contiguous=lambda: False)),
        (as_torch, dict(dtype="torch.bfloat16")),
        (as_torch, dict(get_device=lambda: 1)),
        (as_cupy, dict(flags=NUMBERS[:, ::2].flags)),
        (as_cupy, dict(dtype=np.dtype(np.float16))),
        (as_cupy, dict(device=types.SimpleNamespace(id=1))),
        (as_jax, dict(device="a sharding")),
        (as_jax, dict(device=types.SimpleNamespace(local_hardware_id=1))),
        (as_jax, dict(dtype=np.dtype(np.float16))),
    ],
)
def test_other_arrays_are_left_to_dlpack(make, facts, device):
    """Among them arrays that must be refused: DLPack knows how."""
    from gpusense.backends.warp.arrays import adopted

    error = TypeError if facts.get("requires_grad") else BufferError
    with pytest.raises(error, match=r"by DLPack|must not require gradients"):
        adopted(make(NUMBERS, **facts), device, "poses")
    kind = type(make(NUMBERS))
    below = type(kind.__name__, (kind,), {"__module__": kind.__module__})
    if make is not as_jax:
        with pytest.raises(BufferError, match="by DLPack"):
            adopted(below(**vars(make(NUMBERS))), device, "poses")


@pytest.mark.parametrize("make", [as_torch, as_cupy, "as_older_torch"])
def test_the_device_follows_the_stream_of_the_library(make, device, monkeypatch):
    """Blocking streams follow the legacy stream without an event; no other stream does."""
    from gpusense.backends.warp.arrays import adopted

    if make == "as_older_torch":
        monkeypatch.delattr(sys.modules["torch"]._C, "_cuda_getCurrentRawStream")
    array = (as_torch if make == "as_older_torch" else make)(NUMBERS)
    for handle, blocking, waited in (
        (0, True, []), (1, True, []), (5, True, []), (2, True, [2]), (SIDE_STREAM, True, [SIDE_STREAM]),
        (0, False, [0]), (5, False, []),
    ):  # fmt: skip
        device.current.handle, device.stream = handle, Stream(is_blocking=blocking)
        adopted(array, device, "poses")
        assert device.stream.waited == waited, (handle, blocking)


@pytest.mark.parametrize("make", [as_torch, as_cupy])
def test_results_are_allocated_by_the_library(make, device):
    from gpusense.backends.warp.arrays import Results

    empty_like = Results(device, None).empty_like
    made: list[Any] = []
    facts = {}
    if make is as_torch:
        facts["new_empty"] = lambda shape, dtype: made.append(as_torch(np.full(shape, 7, dtype[6:]))) or made[-1]
    poses = make(NUMBERS, **facts)
    array, buffer = empty_like(poses, (4, 2), np.dtype(np.float32))
    assert type(array) is type(poses) and array.numbers.shape == (4, 2)
    assert buffer.ptr == array.numbers.ctypes.data and (buffer.numpy() == 7).all() and buffer.size == 8
    assert empty_like(poses, (0,), np.dtype(np.float32)) is None
    assert empty_like(as_jax(NUMBERS), (4,), np.dtype(np.float32)) is None


def test_memory_of_freed_results_is_used_again(needs):
    """Arrays that share memory with a result keep it: views, and arrays that other libraries make of it."""
    import warp as wp
    from support.array_libraries import to_device

    from gpusense.backends.warp.arrays import _MOST_KEPT, Results

    needs("warp")
    poses, owners = to_device(NUMBERS), [Results(wp.get_device("cpu"), get_backend("warp:cpu").empty)]

    def made(count: int = 8, real: type = np.float32) -> Any:
        return owners[0].empty_like(poses, (count,), np.dtype(real))[0]

    for view in (lambda one: one[2:5], lambda one: one.reshape((2, 4)), np.from_dlpack, wp.from_dlpack):
        one = made()
        address, part = one.ptr, view(one)
        del one
        assert made().ptr != address
        del part
        assert made().ptr == address
        assert made(real=np.float64).ptr != address
    kept = [made(count) for count in range(1, 30)]
    assert len({one.ptr for one in kept}) == 29
    kept.clear()
    assert len(owners[0]._free) == _MOST_KEPT
    last = made()
    owners.clear()
    last.fill_(3.0)
    assert (last.numpy() == 3.0).all()


def test_freed_memory_waits_for_every_blocking_stream(needs):
    """The current stream follows the legacy stream when memory is taken; a capture forbids that."""
    import warp as wp

    from gpusense.backends.warp.arrays import Results

    needs("warp")
    events: list[Any] = []
    null, current = object(), types.SimpleNamespace(wait_stream=events.append)
    device = types.SimpleNamespace(
        is_cuda=True, captures={}, null_stream=null, stream=current, context_guard=contextlib.nullcontext()
    )
    results, block = Results(device, get_backend("warp:cpu").empty), wp.zeros(32, dtype=wp.uint8, device="cpu")
    for _ in range(2):
        results.take_back(block)
        assert results._memory(32) is block
    assert events == [null, null]
    results.take_back(block)
    device.captures[1] = "a capture"
    assert results._memory(32) is not block
    results.take_back(block)
    device.captures.clear()
    assert results._memory(32) is block and len(events) == 3
    device.captures[1] = "a capture"
    results.take_back(block)
    device.captures.clear()
    assert results._memory(32) is not block and len(events) == 3


def test_an_array_of_warp(needs):
    import warp as wp
    from support.array_libraries import to_device

    from gpusense.backends.warp.arrays import adopted

    needs("warp")
    host, array = wp.get_device("cpu"), to_device(NUMBERS)
    found = adopted(array, host, "poses")
    assert found.buffer.ptr == array.ptr and found.buffer.shape == (12,) and found.owner is array
    strided = adopted(array[:, :2], host, "poses")
    assert strided.strides == (24, 8) and not strided.contiguous
    assert (strided.to_host() == NUMBERS[:, :2]).all()


def test_results_are_allocated_ahead_for_the_current_stream_alone(device):
    import warp as wp
    from support.array_libraries import to_device

    from gpusense.backends.warp.backend import WarpBackend

    array, there = to_device(NUMBERS), types.SimpleNamespace(is_cuda=True, stream=object())
    backend: Any = types.SimpleNamespace(_device=there)
    before = WarpBackend.ahead(backend, array)
    assert before == WarpBackend.ahead(backend, array) == (wp.array, there.stream)
    there.stream = object()
    assert WarpBackend.ahead(backend, array) != before
    assert WarpBackend.ahead(backend, as_torch(NUMBERS)) is None, "PyTorch has streams of its own"
