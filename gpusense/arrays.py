"""Arrays of other libraries: what is on the device is used there, what is in host memory is seen as NumPy sees it.

Two protocols are understood: DLPack (PyTorch, CuPy, JAX, Warp, NumPy) and the CUDA array interface.
"""

from __future__ import annotations

import functools
import sys
from typing import Any

import numpy as np

from gpusense._checks import shape_text, show
from gpusense.backends.base import Backend, Buffer

# DLPack's numbers for memory that the processor reads: its own, and that pinned for CUDA or ROCm.
_HOST = (1, 3, 11)


def on_device(array: object) -> bool:
    """Whether an object is an array in the memory of a device that is not the processor."""
    if isinstance(array, (np.ndarray, list, tuple)):
        return False
    if hasattr(array, "__dlpack_device__"):
        return array.__dlpack_device__()[0] not in _HOST
    return hasattr(array, "__cuda_array_interface__")


def to_host(array: object, name: str = "poses") -> object:
    """A NumPy view of an array of another library in host memory, anything else as it is.

    Raises:
        TypeError: a tensor whose gradients are recorded.
    """
    if isinstance(array, (np.ndarray, list, tuple)) or not hasattr(array, "__dlpack__"):
        return array
    try:
        return np.from_dlpack(array)
    except (BufferError, RuntimeError, TypeError, AttributeError) as error:
        _check_gradients(array, name, error)
        return array


def _check_gradients(array: object, name: str, error: Exception) -> None:
    """Say why an array is not exported where its library records its gradients, which are not computed here."""
    if getattr(array, "requires_grad", False) is True:
        raise TypeError(
            f"{name}: must not require gradients, which are not computed here, got a "
            f"{type(array).__module__}.{type(array).__name__} that does: pass {name}.detach()"
        ) from error


def copied_to_host(array: object, backend: Backend, name: str) -> object:
    """Readings as NumPy has them; those on the device are copied, which waits for it."""
    if not on_device(array):
        return to_host(array, name)
    return _adopt(array, backend, name).numpy()


def _adopt(array: Any, backend: Backend, name: str) -> Any:
    """An array on the device as Warp sees it, without a copy.

    Raises:
        TypeError: the backend cannot read it.
    """
    info = backend.info
    if info.backend != "warp" or info.kind != "gpu":
        raise TypeError(
            f"{name}: must be in host memory for {info.selection}, or the model made with backend='warp:cuda:<n>', got "
            f"a {type(array).__module__}.{type(array).__name__} on a device"
        )
    import warp as wp

    if isinstance(array, wp.array):
        found = array
    elif hasattr(array, "__dlpack__"):
        try:
            found = wp.from_dlpack(array)
        except (BufferError, RuntimeError, TypeError) as error:
            _check_gradients(array, name, error)
            raise
    else:
        interface = array.__cuda_array_interface__
        dtype = {"<f4": wp.float32, "<f8": wp.float64, "<i4": wp.int32, "<i8": wp.int64}.get(interface["typestr"])
        if dtype is None:
            raise TypeError(f"{name}: must hold float32 or float64, got {show(interface['typestr'])}")
        found = wp.array(
            ptr=interface["data"][0], dtype=dtype, shape=interface["shape"], strides=interface.get("strides"),
            device=info.selection.removeprefix("warp:"), copy=False,
        )  # fmt: skip
        found._gpusense_owner = array
        if interface.get("stream") is not None:
            # What another stream still writes must be there; of DLPack's arrays their own library sees to that.
            wp.synchronize_device(found.device)
    if f"warp:{found.device.alias}" != info.selection:
        raise TypeError(f"{name}: must be on {info.selection}, got an array on {found.device.alias}")
    return found


@functools.lru_cache(maxsize=64)
def _flat(address: int, count: int, dtype: Any, device: str) -> Buffer:
    """Memory on the device as a flat buffer that does not own it."""
    import warp as wp

    return wp.array(ptr=address, dtype=dtype, shape=(count,), device=device)


def adopt_poses(array: object, backend: Backend, name: str, several: bool = False) -> tuple[Buffer, int, bool, object]:
    """(N, 3) poses on the device as a flat buffer, their number, whether they are float32, and what owns the memory.

    Several scans have (S, N, 3) poses, S N altogether.

    Raises:
        TypeError: not float32 or float64, or not on the backend's device.
        ValueError: another shape, or not C-contiguous.
    """
    import warp as wp

    found = _adopt(array, backend, name)
    wanted = ("S", "N", 3) if several else ("N", 3)
    if found.ndim != len(wanted) or found.shape[-1] != 3:
        raise ValueError(f"{name}: shape must be {shape_text(wanted)}, got {shape_text(found.shape)}")
    if found.dtype not in (wp.float32, wp.float64):
        raise TypeError(f"{name}: must hold float32 or float64, got {found.dtype.__name__}")
    if not found.is_contiguous:
        raise ValueError(f"{name}: must be C-contiguous on the device, got strides {found.strides}")
    count = found.size // 3
    flat = _flat(found.ptr, 3 * count, found.dtype, found.device.alias) if count else found.flatten()
    return flat, count, found.dtype == wp.float32, found


def adopt_readings(array: object, backend: Backend, beams: int) -> Buffer:
    """(K,) ranges on the device as a flat buffer; what owns the memory is kept by it.

    Raises:
        TypeError: not float32 or float64, or not on the backend's device.
        ValueError: another shape, or not C-contiguous.
    """
    import warp as wp

    found = _adopt(array, backend, "ranges")
    if tuple(found.shape) != (beams,):
        raise ValueError(f"ranges: shape must be ({beams},), got {shape_text(found.shape)}")
    if found.dtype not in (wp.float32, wp.float64):
        raise TypeError(f"ranges: must hold float32 or float64, got {found.dtype.__name__}")
    if not found.is_contiguous:
        raise ValueError(f"ranges: must be C-contiguous on the device, got strides {found.strides}")
    return found


def blank(backend: Backend, count: int, real: np.dtype) -> Buffer:
    """A buffer for a result of exactly so many numbers, or none."""
    buffer = backend.empty(count, real)
    return buffer if count else backend.part(buffer, 0, 0)


def result_for(given: object, buffer: Buffer) -> object:
    """A result on the device as an array of the library that the poses came from."""
    library = sys.modules.get(type(given).__module__.partition(".")[0])
    if library is None:
        return buffer
    if library.__name__ == "warp":
        return library.array(buffer, copy=False, device="cpu") if isinstance(buffer, np.ndarray) else buffer
    if library.__name__.startswith("jax"):
        library = sys.modules["jax.numpy"]
    convert = getattr(library, "from_dlpack", None)
    return buffer if convert is None else convert(buffer)


def like(given: object, result: np.ndarray) -> Any:
    """A NumPy result as an array of the library that the poses came from, without a copy."""
    if isinstance(given, (np.ndarray, list, tuple)) or not hasattr(given, "__dlpack__"):
        return result
    return result_for(given, result)


def check_out(out: object, shape: tuple[int, ...], real: np.dtype, given: object, backend: Backend) -> Any:
    """Where a result is to be written: a NumPy array, or a flat buffer on the device; None where a new one is wanted.

    Raises:
        TypeError: not an array of the precision in the memory where the poses are.
        ValueError: another shape, not C-contiguous, or read-only.
    """
    if out is None:
        return None
    if on_device(out) != on_device(given):
        raise TypeError("out: must be in the memory where the poses are, got one that is not")
    if on_device(out):
        found = _adopt(out, backend, "out")
        dtype, contiguous = found.dtype.__name__, found.is_contiguous
        same, writeable, found_shape = dtype == real.name, True, found.shape
    else:
        found = to_host(out, "out")
        if not isinstance(found, np.ndarray):
            raise TypeError(f"out: must be an array, got {show(out)}")
        if not found.flags.writeable and found is not out:
            # Exporters of the first DLPack cannot say that memory may be written; NumPy's own protocols can.
            plain = np.asarray(out)
            found = plain if plain.ctypes.data == found.ctypes.data else found
        same, found_shape = found.dtype == real, found.shape
        dtype = "" if same else found.dtype.name
        contiguous, writeable = found.flags.c_contiguous, found.flags.writeable
    if not same:
        raise TypeError(f"out: must hold {real.name}, got {dtype}")
    if tuple(found_shape) != shape:
        raise ValueError(f"out: shape must be {shape_text(shape)}, got {shape_text(found_shape)}")
    if not contiguous or not writeable:
        raise ValueError("out: must be C-contiguous and writable, got one that is not")
    return found.flatten() if on_device(out) else found
