"""Arrays of other libraries: what is on the device is used there, what is in host memory is seen as NumPy sees it.

Two protocols are understood: DLPack (PyTorch, CuPy, JAX, Warp, NumPy) and the CUDA array interface; and arrays of
pyopencl, which have neither.
"""

from __future__ import annotations

import math
import sys
from typing import Any

import numpy as np

from gpusense._util.checks import check_gradients, shape_text, show
from gpusense.backends.base import Adopted, Backend, Buffer

# DLPack's numbers for memory that the processor reads: its own, and that pinned for CUDA or ROCm.
_HOST = (1, 3, 11)


def on_device(array: object) -> bool:
    """Whether an object is an array in the memory of a device that is not the processor."""
    if isinstance(array, (np.ndarray, list, tuple)):
        return False
    if hasattr(array, "__dlpack_device__"):
        return array.__dlpack_device__()[0] not in _HOST
    return hasattr(array, "__cuda_array_interface__") or _is_opencl(array)


def _is_opencl(array: object) -> bool:
    """Whether an object is an array of pyopencl."""
    module = sys.modules.get("pyopencl.array")
    return module is not None and isinstance(array, module.Array)


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
        check_gradients(array, name, error)
        return array


def copied_to_host(array: object, backend: Backend, name: str) -> object:
    """Readings as NumPy has them; those on the device are copied, which waits for it."""
    if not on_device(array):
        return to_host(array, name)
    return _adopt(array, backend, name).to_host()


def _adopt(array: Any, backend: Backend, name: str, *, in_place: bool = False) -> Adopted:
    """An array on the device as its backend sees it.

    Raises:
        TypeError: the backend cannot read it.
        ValueError: see Backend.adopt.
    """
    info, opencl = backend.info, _is_opencl(array)
    if info.backend == ("opencl" if opencl else "warp") and (opencl or info.kind == "gpu"):
        return backend.adopt(array, name, in_place=in_place)
    other = "backend=<the array's queue>" if opencl else "backend='warp:cuda:<n>'"
    raise TypeError(
        f"{name}: must be in host memory for {info.selection}, or the model made with {other}, got a "
        f"{type(array).__module__}.{type(array).__name__} on a device"
    )


def adopt_poses(
    array: object, backend: Backend, name: str, several: bool = False, *, in_place: bool = False
) -> tuple[Buffer, int, bool, object]:
    """(N, 3) poses on the device as a flat buffer, their number, whether they are float32, and what owns the memory.

    Several scans have (S, N, 3) poses, S N altogether.

    Raises:
        TypeError: not float32 or float64, or not on the backend's device.
        ValueError: another shape, not C-contiguous, or of use only as a copy where that must not be.
    """
    found = _adopt(array, backend, name, in_place=in_place)
    if not backend.info.float64:
        raise TypeError(f"{name}: must be in host memory on {backend.info.name}, which has no float64 to place them")
    wanted = ("S", "N", 3) if several else ("N", 3)
    if len(found.shape) != len(wanted) or found.shape[-1] != 3:
        raise ValueError(f"{name}: shape must be {shape_text(wanted)}, got {shape_text(found.shape)}")
    _check_numbers(found, name)
    return found.buffer, math.prod(found.shape) // 3, found.dtype == np.float32, found.owner


def adopt_readings(array: object, backend: Backend, beams: int, *, in_place: bool) -> Adopted:
    """(K,) ranges on the device.

    Raises:
        TypeError: not float32 or float64, or not on the backend's device.
        ValueError: another shape, not C-contiguous, or of use only as a copy where that must not be.
    """
    found = _adopt(array, backend, "ranges", in_place=in_place)
    if found.shape != (beams,):
        raise ValueError(f"ranges: shape must be ({beams},), got {shape_text(found.shape)}")
    _check_numbers(found, "ranges")
    return found


def _check_numbers(found: Adopted, name: str) -> None:
    dtype = found.dtype.name if found.dtype.isnative else found.dtype.str
    if found.dtype not in (np.float32, np.float64):
        raise TypeError(f"{name}: must hold float32 or float64, got {dtype}")
    if not found.contiguous:
        raise ValueError(f"{name}: must be C-contiguous on the device, got strides {found.strides}")


def blank(backend: Backend, count: int, real: np.dtype) -> Buffer:
    """A buffer on the device for a result of exactly so many numbers, or none."""
    return backend.blank(count, real)


def lent(given: object, backend: Backend, buffer: Buffer, shape: tuple[int, ...], real: np.dtype) -> object:
    """A result on the device as an array of the library that the poses came from."""
    return _converted(given, backend.lend(buffer, shape, real))


def _converted(given: object, result: Any) -> object:
    """An array of Warp, pyopencl or NumPy as one of the library that the poses came from."""
    library = sys.modules.get(type(given).__module__.partition(".")[0])
    if library is None:
        return result
    if library.__name__ == "warp":
        return library.array(result, copy=False, device="cpu") if isinstance(result, np.ndarray) else result
    if library.__name__.startswith("jax"):
        library = sys.modules["jax.numpy"]
    convert = getattr(library, "from_dlpack", None)
    return result if convert is None else convert(result)


def like(given: object, result: np.ndarray) -> Any:
    """A NumPy result as an array of the library that the poses came from, without a copy."""
    if isinstance(given, (np.ndarray, list, tuple)) or not hasattr(given, "__dlpack__"):
        return result
    return _converted(given, result)


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
        there = _adopt(out, backend, "out", in_place=True)
        _check_result(there.dtype, there.shape, there.contiguous, real, shape)
        return there.buffer
    found = to_host(out, "out")
    if not isinstance(found, np.ndarray):
        raise TypeError(f"out: must be an array, got {show(out)}")
    if not found.flags.writeable and found is not out:
        # Exporters of the first DLPack cannot say that memory may be written; NumPy's own protocols can.
        plain = np.asarray(out)
        found = plain if plain.ctypes.data == found.ctypes.data else found
    _check_result(found.dtype, found.shape, found.flags.c_contiguous and found.flags.writeable, real, shape)
    return found


def _check_result(
    dtype: np.dtype, found: tuple[int, ...], usable: bool, real: np.dtype, shape: tuple[int, ...]
) -> None:
    if dtype != real:
        raise TypeError(f"out: must hold {real.name}, got {dtype.name}")
    if found != shape:
        raise ValueError(f"out: shape must be {shape_text(shape)}, got {shape_text(found)}")
    if not usable:
        raise ValueError("out: must be C-contiguous and writable, got one that is not")
