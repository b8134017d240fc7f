"""Arrays of other libraries: device arrays are used in place, host arrays become NumPy views.

Two protocols are read: DLPack (PyTorch, CuPy, JAX, Warp, NumPy) and the CUDA array interface. The registry of backends
names the libraries whose arrays have neither.
"""

from __future__ import annotations

import math
import os
import sys
from typing import Any

import numpy as np

from gpusense._util import checks
from gpusense._util.checks import check_gradients, shape_text, show
from gpusense.backends import processor
from gpusense.backends.base import Adopted, Backend, Buffer
from gpusense.backends.registry import entry_of_array, selection_for

# DLPack's numbers for memory that the processor reads: host memory, also pinned for CUDA or ROCm.
_HOST = (1, 3, 11)
# Number of poses in a row whose numbers are reduced side by side, and number below which poses are transposed instead.
_WIDTH, _FEW = 256, 1 << 14
# Least number of poses whose bounds are worth a thread, and largest number of threads: more wait for each other.
_SHARE, _MOST_SHARES = 1 << 16, 4

FLOATS = (np.dtype(np.float32), np.dtype(np.float64))

Bounds = tuple[tuple[float, ...], tuple[float, ...]]
"""The least and the largest x, y and theta of poses."""


def on_device(array: object) -> bool:
    """Return whether an object is an array in the memory of a device other than the processor."""
    if isinstance(array, (np.ndarray, list, tuple)):
        return False
    # PyTorch answers this in a tenth of the time of the protocol.
    if isinstance(array, Adopted) or getattr(array, "is_cuda", None) is True:
        return True
    if hasattr(array, "__dlpack_device__"):
        return array.__dlpack_device__()[0] not in _HOST
    return hasattr(array, "__cuda_array_interface__") or entry_of_array(array) is not None


def to_host(array: object, name: str = "poses") -> object:
    """Return a NumPy view of an array of another library in host memory; return other objects unchanged."""
    if isinstance(array, (np.ndarray, list, tuple)):
        return checks.unmasked(name, array)
    if not hasattr(array, "__dlpack__"):
        return array
    try:
        return np.from_dlpack(array)
    except (BufferError, RuntimeError, TypeError, AttributeError) as error:
        check_gradients(array, name, error)
        return array


def copied_to_host(array: object, backend: Backend, name: str) -> object:
    """Return readings as a NumPy array, NaN where masked; device arrays are copied after the device has finished."""
    if type(array) is np.ndarray:
        return array
    array = checks.filled(array)
    if not on_device(array):
        return to_host(array, name)
    return adopt(array, backend, name).to_host()


def adopt(array: Any, backend: Backend, name: str, *, in_place: bool = False) -> Adopted:
    """Return an array on the device as a buffer of the backend."""
    if isinstance(array, Adopted):
        return array
    if backend.reads(array):
        return backend.adopt(array, name, in_place=in_place)
    raise TypeError(
        f"{name}: must be in host memory for {backend.info.selection}, or the model made with "
        f"backend={selection_for(array)}, got a {type(array).__module__}.{type(array).__name__} on a device"
    )


def host_poses(array: object, name: str, scans: int | None = None, *, single: bool = False) -> np.ndarray:
    """Return (N, 3) host poses, or those of S scans in sequence, as C-contiguous float64; ``single`` keeps float32."""
    read = array if type(array) is np.ndarray else to_host(array, name)
    shape = ("N", 3) if scans is None else (scans, "N", 3)
    if scans is None and isinstance(read, np.ndarray) and read.dtype.kind == "f" and read.shape[1:] == (3,):
        return np.ascontiguousarray(read, None if single and read.dtype == np.float32 else np.float64)
    return np.ascontiguousarray(checks.array(name, read, shape, finite=False)).reshape(-1, 3)


def refuse_poses(poses: np.ndarray, name: str, scans: int | None = None) -> None:
    """Raise the error of poses in host memory that are not finite."""
    shape = ("N", 3) if scans is None else (scans, "N", 3)
    checks.array(name, poses if scans is None else poses.reshape(scans, -1, 3), shape)


def bounds_of(poses: np.ndarray) -> Bounds:
    """Return the minimum and maximum of each column of (N, 3) poses; 0 without poses, NaN for a column with NaN.

    Columns of three are slow to reduce; rows are not. Few poses are transposed. Many poses form rows of 256 neighbours,
    and rows are reduced one after the other, by several threads for very many poses.
    """
    count = len(poses)
    if not count:
        return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    if count < _FEW:
        rows = np.ascontiguousarray(poses.T)
        low, high = np.minimum.reduce(rows, axis=1), np.maximum.reduce(rows, axis=1)
    elif count < 2 * _SHARE:
        low, high = _bounds_of_many(poses)
    else:
        step = max(-(-count // min(processor.threads(), _MOST_SHARES)), _SHARE)
        started = [
            processor.pool(os.getpid()).submit(_bounds_of_many, poses[begin : begin + step])
            for begin in range(step, count, step)
        ]
        try:
            parts = [_bounds_of_many(poses[:step]), *(one.result() for one in started)]
        finally:
            processor.finish(started)
        low = np.minimum.reduce([part[0] for part in parts])
        high = np.maximum.reduce([part[1] for part in parts])
    # Both functions propagate NaN.
    return tuple(low.tolist()), tuple(high.tolist())


def _bounds_of_many(poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and the largest of each column of ``_WIDTH`` poses or more."""
    rows = len(poses) // _WIDTH
    body, rest = poses[: rows * _WIDTH].reshape(rows, 3 * _WIDTH), poses[rows * _WIDTH :]
    low, high = np.minimum.reduce(body, axis=0).reshape(-1, 3), np.maximum.reduce(body, axis=0).reshape(-1, 3)
    bounds = np.array([bounds_of(np.concatenate([low, rest]))[0], bounds_of(np.concatenate([high, rest]))[1]])
    return bounds[0], bounds[1]


def adopt_poses(
    array: object, backend: Backend, name: str, scans: int | None = None, *, in_place: bool = False
) -> tuple[Buffer, int, bool, object]:
    """Return device poses as a flat buffer, their number, whether they are float32, and the owner of the memory."""
    adopted = adopt(array, backend, name, in_place=in_place)
    if not backend.info.float64:
        raise TypeError(f"{name}: must be in host memory on {backend.info.name}, which has no float64 to place them")
    wanted = ("N", 3) if scans is None else (scans, "N", 3)
    if len(adopted.shape) != len(wanted) or adopted.shape[-1] != 3 or adopted.shape[:-2] != wanted[:-2]:
        raise ValueError(f"{name}: shape must be {shape_text(wanted)}, got {shape_text(adopted.shape)}")
    _check_numbers(adopted, name)
    return adopted.buffer, math.prod(adopted.shape) // 3, adopted.dtype == np.float32, adopted.owner


def adopt_readings(array: object, backend: Backend, shape: tuple[int, ...], *, in_place: bool) -> Adopted:
    """Return ranges of a shape on the device."""
    adopted = adopt(array, backend, "ranges", in_place=in_place)
    if adopted.shape != shape:
        raise ValueError(f"ranges: shape must be {shape_text(shape)}, got {shape_text(adopted.shape)}")
    _check_numbers(adopted, "ranges")
    return adopted


def adopt_numbers(array: object, backend: Backend, name: str) -> Adopted:
    """Return a C-contiguous array of float32 or float64 numbers on the device."""
    adopted = adopt(array, backend, name)
    _check_numbers(adopted, name)
    return adopted


def adopt_integers(array: object, backend: Backend, name: str, kinds: tuple[str, ...]) -> Adopted:
    """Return a C-contiguous array of integers on the device."""
    adopted = adopt(array, backend, name)
    if adopted.dtype.name not in kinds:
        raise TypeError(f"{name}: must hold {' or '.join(kinds)} on the device, got {adopted.dtype.name}")
    _check_contiguous(adopted, name)
    return adopted


def _check_numbers(adopted: Adopted, name: str) -> None:
    """Refuse numbers of another type than float32 or float64, and arrays that are not C-contiguous."""
    if adopted.dtype not in FLOATS:
        dtype = adopted.dtype.name if adopted.dtype.isnative else adopted.dtype.str
        raise TypeError(f"{name}: must hold float32 or float64, got {dtype}")
    _check_contiguous(adopted, name)


def _check_contiguous(adopted: Adopted, name: str) -> None:
    if adopted.strides is not None:
        raise ValueError(f"{name}: must be C-contiguous on the device, got strides {adopted.strides}")


def wrapped(poses: object, backend: Backend, buffer: Buffer, shape: tuple[int, ...], real: np.dtype) -> object:
    """Return a result on the device as an array of the library of the poses."""
    return _converted(poses, backend.wrap_external(buffer, shape, real))


def _converted(poses: object, result: Any) -> object:
    """Convert an array of Warp, pyopencl or NumPy to the library of the poses."""
    library = sys.modules.get(type(poses).__module__.partition(".")[0])
    if library is None:
        return result
    if library.__name__ == "warp":
        return library.array(result, copy=False, device="cpu") if isinstance(result, np.ndarray) else result
    if library.__name__.startswith("jax"):
        library = sys.modules["jax.numpy"]
    convert = getattr(library, "from_dlpack", None)
    return result if convert is None else convert(result)


def like(poses: object, result: np.ndarray) -> Any:
    """Return a NumPy result as an array of the library of the poses, without a copy."""
    if isinstance(poses, (np.ndarray, list, tuple)) or not hasattr(poses, "__dlpack__"):
        return result
    return _converted(poses, result)


def check_out(out: object, shape: tuple[int, ...], real: np.dtype, backend: Backend, *, device_poses: bool) -> Any:
    """Return the memory of ``out=``: a NumPy array, or a flat buffer on the device; None where ``out`` is None."""
    if out is None:
        return None
    if on_device(out) != device_poses:
        raise TypeError("out: must be in the memory where the poses are, got one that is not")
    if device_poses:
        adopted = adopt(out, backend, "out", in_place=True)
        _check_result(adopted.dtype, adopted.shape, adopted.contiguous, real, shape)
        return adopted.buffer
    view = to_host(out, "out")
    if not isinstance(view, np.ndarray):
        raise TypeError(f"out: must be an array, got {show(out)}")
    if not view.flags.writeable and view is not out:
        # Exporters of the first DLPack cannot mark memory as writable; NumPy's own protocols can.
        plain = np.asarray(out)
        view = plain if plain.ctypes.data == view.ctypes.data else view
    _check_result(view.dtype, view.shape, view.flags.c_contiguous and view.flags.writeable, real, shape)
    return view


def _check_result(
    dtype: np.dtype, shape: tuple[int, ...], usable: bool, real: np.dtype, wanted: tuple[int, ...]
) -> None:
    """Check ``out`` against its rules."""
    if dtype != real:
        raise TypeError(f"out: must hold {real.name}, got {dtype.name}")
    if shape != wanted:
        raise ValueError(f"out: shape must be {shape_text(wanted)}, got {shape_text(shape)}")
    if not usable:
        raise ValueError("out: must be C-contiguous and writable, got one that is not")


class Result:
    """The memory of a result: the array ``out=``, or new memory where the poses are, of their library.

    ``flat``: a flat NumPy array, or a buffer on the device.
    """

    def __init__(
        self, poses: Any, out: Any, shape: tuple[int, ...], real: np.dtype, backend: Backend, *, on_device: bool
    ) -> None:
        self._poses, self._out, self._shape, self._real, self._backend = poses, out, shape, real, backend
        self._on_device = on_device
        if out is not None:
            self.flat = check_out(out, shape, real, backend, device_poses=on_device)
        elif on_device:
            made = backend.empty_like(poses, shape, real)
            if made is None:
                self.flat = backend.empty_external(math.prod(shape), real)
            else:
                self._out, self.flat = made
        else:
            self.flat = np.empty(shape, real) if backend.results is None else backend.results.empty(shape, real)
        if not on_device:
            self.flat = self.flat.reshape(-1)

    def user_array(self) -> Any:
        """Return ``out``, or the result as an array of the library of the poses."""
        if self._out is not None:
            return self._out
        if self._on_device:
            return wrapped(self._poses, self._backend, self.flat, self._shape, self._real)
        result = self.flat.reshape(self._shape)
        return result if type(self._poses) is np.ndarray else like(self._poses, result)
