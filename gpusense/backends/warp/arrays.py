"""Arrays of other libraries on a CUDA device, as Warp sees them without a copy."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import warp as wp

from gpusense._util.checks import check_gradients, show
from gpusense.backends.base import Adopted, Buffer


def adopted(array: Any, device: wp.Device, name: str) -> Adopted:
    """See Sharing.adopt."""
    found = _seen(array, device, name)
    if found.device != device:
        raise TypeError(f"{name}: must be on warp:{device.alias}, got an array on {found.device.alias}")
    try:
        dtype = np.dtype(wp.dtype_to_numpy(found.dtype))
    except TypeError as error:
        raise TypeError(f"{name}: must hold float32 or float64, got {found.dtype.__name__}") from error
    buffer = found
    if found.is_contiguous and found.ndim != 1:
        buffer = _flat(found.ptr, found.size, found.dtype, device.alias) if found.size else found.flatten()
    return Adopted(buffer, tuple(found.shape), dtype, tuple(found.strides), found.is_contiguous, found.numpy, found)


def _seen(array: Any, device: wp.Device, name: str) -> wp.array:
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
    found = wp.array(
        ptr=interface["data"][0], dtype=dtype, shape=interface["shape"], strides=interface.get("strides"),
        device=device, copy=False,
    )  # fmt: skip
    found._gpusense_owner = array
    if interface.get("stream") is not None:
        # What another stream still writes must be there; of DLPack's arrays their own library sees to that.
        wp.synchronize_device(found.device)
    return found


@functools.lru_cache(maxsize=64)
def _flat(address: int, count: int, dtype: Any, device: str) -> Buffer:
    """Memory on the device as a flat buffer that does not own it."""
    return wp.array(ptr=address, dtype=dtype, shape=(count,), device=device)
