"""Arrays of other libraries on a CUDA device as Warp's, without a copy."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import warp as wp

from gpusense._util.checks import check_gradients, show
from gpusense.backends.base import Adopted, Buffer
from gpusense.backends.processor import Slot


def has_protocol(array: object) -> bool:
    """Return whether Warp can take an array: by DLPack or the CUDA array interface."""
    return hasattr(array, "__dlpack__") or hasattr(array, "__cuda_array_interface__")


def adopted(array: Any, device: wp.Device, name: str) -> Adopted:
    """See Backend.adopt."""
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
    return Adopted(buffer, tuple(view.shape), dtype, tuple(view.strides), view.is_contiguous, view.numpy, view)


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
    dtype = {"<f4": wp.float32, "<f8": wp.float64, "<i4": wp.int32, "<i8": wp.int64}.get(interface["typestr"])
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
