"""Arrays of other libraries on a CUDA device as Warp's, without a copy.

Addresses of arrays of Warp, PyTorch, CuPy and JAX are read directly, in a tenth of the time of DLPack, which serves all
other libraries. The device's current stream then follows the stream of the array's library, as DLPack demands.
"""

from __future__ import annotations

import contextlib
import functools
import math
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

from gpusense._util.checks import check_gradients, show
from gpusense.backends.base import Adopted, Buffer
from gpusense.backends.processor import Slot
from gpusense.backends.recycled import FreedMemory, Loan

# Types of numbers that are read, by their names, and Warp's types.
_NAMES = {name: np.dtype(name) for name in ("float32", "float64", "int32", "int64")}
_TYPES = {dtype: getattr(wp, name) for name, dtype in _NAMES.items()}
_NUMPY = {kind: dtype for dtype, kind in _TYPES.items()}
# Handles of CUDA's legacy stream, which blocking streams follow by themselves.
_LEGACY = (None, 0, 1)

# Largest memory of a freed result that is kept [bytes], and largest number of them.
_LARGEST_KEPT, _MOST_KEPT = 256 << 10, 8

Place = tuple[int, tuple[int, ...], np.dtype]
"""Address, shape and type of the numbers of a C-contiguous array."""


def has_protocol(array: object) -> bool:
    """Return whether Warp can take an array: by DLPack or the CUDA array interface."""
    return hasattr(array, "__dlpack__") or hasattr(array, "__cuda_array_interface__")


def adopted(array: Any, device: wp.Device, name: str) -> Adopted:
    """See Backend.adopt."""
    kind: Any = type(array)
    read = _reader_of(kind)
    place = None if read is None else read(array, device)
    if place is not None and place[0]:
        address, shape, dtype = place
        buffer = _flat(address, math.prod(shape), _TYPES[dtype], device.alias)
        return Adopted(buffer, shape, dtype, lambda: buffer.numpy().reshape(shape), array)
    view = _view(array, device, name)
    if view.device != device:
        raise TypeError(f"{name}: must be on warp:{device.alias}, got an array on {view.device.alias}")
    try:
        dtype = np.dtype(wp.dtype_to_numpy(view.dtype))
    except TypeError as error:
        raise TypeError(f"{name}: must hold float32 or float64, got {view.dtype.__name__}") from error
    buffer = view
    if view.is_contiguous and view.ndim != 1:
        buffer = _flat(view.ptr, view.size, view.dtype, device.alias) if view.size else view.flatten()
    return Adopted(buffer, tuple(view.shape), dtype, view.numpy, view, None if view.is_contiguous else view.strides)


class Results(FreedMemory):
    """New arrays for results, each of the library of the poses.

    PyTorch and CuPy allocate faster than Warp, which would also have to export the array. Memory of a few freed small
    arrays of Warp is kept for the next ones: an allocation takes as long as a launch, and calls whose addresses repeat
    are recorded.
    """

    def __init__(self, device: wp.Device, empty: Callable[[int, np.dtype], Buffer]) -> None:
        super().__init__(_MOST_KEPT, _MOST_KEPT * _LARGEST_KEPT)
        self._device, self._empty = device, empty

    def empty_like(self, array: Any, shape: tuple[int, ...], dtype: np.dtype) -> tuple[Any, Buffer] | None:
        """See Backend.empty_like."""
        count, module = math.prod(shape), type(array).__module__.partition(".")[0]
        if not count:
            return None
        if module == "torch" and array.is_cuda:
            try:
                made = array.new_empty(shape, dtype=_torch_type(dtype))
            except RuntimeError as error:
                raise MemoryError(f"PyTorch allocates no result: {error}") from error
            address = made.data_ptr()
        elif module == "cupy" and sys.modules["cupy"].cuda.runtime.getDevice() == self._device.ordinal:
            made = sys.modules["cupy"].empty(shape, dtype)
            address = made.data.ptr
        elif module == "warp" and count * dtype.itemsize <= _LARGEST_KEPT:
            memory = self._memory(count * dtype.itemsize)
            address = memory.ptr
            made = wp.array(ptr=address, dtype=_TYPES[dtype], shape=shape, device=self._device)
            made._gpusense_owner = Loan(self, memory)
        else:
            return None
        return made, _flat(address, count, _TYPES[dtype], self._device.alias)

    def _memory(self, size: int) -> wp.array:
        """Return memory that no array uses."""
        # The legacy stream waits for blocking streams, on which others may still use the memory: Warp frees it there.
        captures = self._device.is_cuda and getattr(self._device, "captures", None)
        memory = None if captures else self.take(size)
        if memory is None:
            return self._empty(size, np.dtype(np.uint8))
        if self._device.is_cuda:
            _wait_for(self._device, self._device.null_stream)
        return memory

    def take_back(self, block: wp.array) -> None:
        """Keep the memory of a freed array."""
        # The interpreter may be ending.
        with contextlib.suppress(AttributeError, TypeError):
            # Warp frees memory once a capture has ended.
            if not (self._device.is_cuda and getattr(self._device, "captures", None)):
                super().take_back(block)


def _view(array: Any, device: wp.Device, name: str) -> wp.array:
    """Return an array of any library as Warp's."""
    if isinstance(array, wp.array):
        return array
    if hasattr(array, "__dlpack__"):
        try:
            return wp.from_dlpack(array)
        except (BufferError, RuntimeError, TypeError) as error:
            check_gradients(array, name, error)
            raise
    interface = array.__cuda_array_interface__
    dtype = _TYPES.get(np.dtype(interface["typestr"]))
    if dtype is None:
        raise TypeError(f"{name}: must hold float32 or float64, got {show(interface['typestr'])}")
    view = wp.array(
        ptr=interface["data"][0], dtype=dtype, shape=interface["shape"], strides=interface.get("strides"),
        device=device, copy=False,
    )  # fmt: skip
    view._gpusense_owner = array
    if interface.get("stream") is not None:
        # The writes of another stream must have ended; libraries with DLPack see to that themselves.
        wp.synchronize_device(view.device)
    return view


@functools.lru_cache(maxsize=64)
def _flat(address: int, count: int, dtype: Any, device: str) -> Buffer:
    """Return memory on the device as a flat buffer that does not own it."""
    return wp.array(ptr=address, dtype=dtype, shape=(count,), device=device)


# ---- places of arrays of four libraries: None for an array that DLPack must read or refuse


def _place_in_warp(array: Any, device: wp.Device) -> Place | None:
    if type(array) is not wp.array or array.device is not device or not array.is_contiguous:
        return None
    dtype = _NUMPY.get(array.dtype)
    return None if dtype is None else (array.ptr, array.shape, dtype)


def _place_in_torch(tensor: Any, device: wp.Device) -> Place | None:
    torch = sys.modules["torch"]
    # Subclasses may hold numbers elsewhere, and negation of a complex part may be pending.
    usable = type(tensor) is torch.Tensor and tensor.is_cuda and tensor.layout is torch.strided
    if not usable or tensor.requires_grad or tensor.is_neg() or not tensor.is_contiguous():
        return None
    dtype = _number_of(tensor.dtype)
    if dtype is None or tensor.get_device() != device.ordinal:
        return None
    try:
        address = tensor.data_ptr()
    except RuntimeError:
        # A tensor without memory, such as a batch of vmap.
        return None
    # The handle alone takes a tenth of the time of the stream.
    handle = getattr(torch._C, "_cuda_getCurrentRawStream", None)
    _follow(device, handle(device.ordinal) if handle else torch.cuda.current_stream(device.ordinal).cuda_stream)
    return address, tuple(tensor.shape), dtype


@functools.cache
def _number_of(dtype: Any) -> np.dtype | None:
    """Return a type of PyTorch as NumPy's; None for one that is not read."""
    return _NAMES.get(str(dtype).removeprefix("torch."))


@functools.cache
def _torch_type(dtype: np.dtype) -> Any:
    """Return a type of NumPy as PyTorch's."""
    return getattr(sys.modules["torch"], dtype.name)


def _place_in_cupy(array: Any, device: wp.Device) -> Place | None:
    cupy = sys.modules["cupy"]
    usable = type(array) is cupy.ndarray and array.dtype in _TYPES and array.flags.c_contiguous
    if not usable or not array.device.id == device.ordinal == cupy.cuda.runtime.getDevice():
        return None
    _follow(device, cupy.cuda.get_current_stream().ptr)
    return array.data.ptr, array.shape, array.dtype


def _place_in_jax(array: Any, device: wp.Device) -> Place | None:
    if getattr(array.device, "local_hardware_id", None) != device.ordinal or array.dtype not in _TYPES:
        return None
    # JAX computes arrays asynchronously.
    array.block_until_ready()
    try:
        interface = array.__cuda_array_interface__
    except (AttributeError, RuntimeError):
        # An array on several devices, in the host's memory, or in another order than C's.
        return None
    return interface["data"][0], array.shape, array.dtype


@functools.cache
def _reader_of(kind: Any) -> Callable[[Any, wp.Device], Place | None] | None:
    """Return the function that reads the places of arrays of a class; None for one that DLPack must read."""
    readers = dict(warp=_place_in_warp, torch=_place_in_torch, cupy=_place_in_cupy, jaxlib=_place_in_jax)
    return readers.get(kind.__module__.partition(".")[0])


def _follow(device: wp.Device, handle: int) -> None:
    """Let the device's current stream wait for the earlier work of another stream."""
    current = device.stream
    if handle != current.cuda_stream and not (handle in _LEGACY and current.is_blocking):
        _wait_for(device, stream_of(device.alias, handle))


def _wait_for(device: wp.Device, stream: wp.Stream) -> None:
    """Let the device's current stream wait for the earlier work of another stream, such as its legacy stream."""
    with device.context_guard:
        device.stream.wait_stream(stream)


@functools.lru_cache(maxsize=16)
def stream_of(device: str, handle: int) -> wp.Stream:
    """Return a stream of another library as Warp's."""
    return wp.Stream(device, cuda_stream=handle)


# ---- page-locked memory for large copies; see :mod:`gpusense.backends.processor`


class WarpSlot(Slot):
    """A piece of page-locked memory, copied on the device's current stream."""

    def __init__(self, device: wp.Device, memory: wp.array, first: int, size: int) -> None:
        self._device, self._memory, self._first = device, memory, first
        self.bytes = memory.numpy()[first : first + size]
        self._copied = wp.Event(device)
        self._busy = False

    def to_device(self, buffer: wp.array, first: int, size: int) -> None:
        wp.copy(self._part_of(buffer, first, size), self._memory, src_offset=self._first, count=size)
        self._started()

    def to_host(self, buffer: wp.array, first: int, size: int) -> None:
        wp.copy(self._memory, self._part_of(buffer, first, size), dest_offset=self._first, count=size)
        self._started()

    def wait(self) -> None:
        if self._busy:
            wp.synchronize_event(self._copied)
            self._busy = False

    def _started(self) -> None:
        """Note the end of the copy on the stream."""
        self._device.stream.record_event(self._copied)
        self._busy = True

    def _part_of(self, buffer: wp.array, first: int, size: int) -> wp.array:
        """Return some bytes of a buffer whose size in bytes exceeds the elements of a Warp array."""
        return wp.array(ptr=buffer.ptr + first, dtype=wp.uint8, shape=(size,), device=self._device)


def slots_of(device: wp.Device, number: int, size: int) -> list[WarpSlot]:
    """Allocate slots of a number of bytes each."""
    memory = wp.empty(number * size, dtype=wp.uint8, device="cpu", pinned=True)
    return [WarpSlot(device, memory, first, size) for first in range(0, number * size, size)]
