"""The NumPy reference as a backend: buffers are arrays, kernels are the functions of ``gpusense.reference``."""

from __future__ import annotations

import importlib
import inspect
from typing import Any

import numpy as np

from gpusense.backends.base import Backend, BackendInfo, Launcher
from gpusense.backends.processor import host_memory
from gpusense.backends.registry import Library
from gpusense.interface import structs
from gpusense.interface.signatures import KERNELS, Argument


def describe() -> BackendInfo:
    """Describe the host as a device."""
    memory = host_memory()
    return BackendInfo("numpy", "numpy", "NumPy reference", "cpu", np.__version__, memory, memory, True)


def _bound(argument: Argument, value: Any, real: np.dtype) -> Any:
    """Return an argument as the reference takes it."""
    if argument.is_struct:
        return structs.rounded(value, argument.type, real)
    if argument.shape is not None:
        return argument.shaped(value)
    dtype = argument.dtype(real)
    return int(value) if dtype.kind == "i" else dtype.type(value)


def _nothing(argument: Argument, real: np.dtype) -> Any:
    """Return a struct of zeros, or an array without numbers."""
    value: Any = [0] * argument.width if argument.is_struct else np.empty(0, argument.dtype(real))
    return _bound(argument, value, real)


class NumpyBackend(Backend):
    """The host, on which the reference kernels run."""

    def __init__(self, info: BackendInfo | None = None) -> None:
        self.info = describe() if info is None else info

    def upload(self, array: np.ndarray, out: np.ndarray | None = None, *, wait: bool = True) -> np.ndarray:
        buffer = self.empty(array.size, array.dtype) if out is None else out
        buffer[: array.size] = array.ravel()
        return buffer

    def empty(self, count: int, dtype: np.dtype, *, zero: bool = False) -> np.ndarray:
        size = count * np.dtype(dtype).itemsize
        if size > self.info.max_buffer:
            raise MemoryError(
                f"{self.info.name} cannot hold a buffer of {size} bytes: its largest is {self.info.max_buffer} bytes"
            )
        return np.zeros(count, dtype) if zero else np.empty(count, dtype)

    def download(self, buffer: np.ndarray, out: np.ndarray, *, wait: bool = True) -> np.ndarray:
        out.reshape(-1)[...] = buffer[: out.size]
        return out

    def part(self, buffer: np.ndarray, first: int, count: int, dtype: np.dtype) -> np.ndarray:
        return buffer.view(dtype)[first : first + count]

    def compile(self, kernel: str, flags: frozenset[str]) -> Launcher:
        row = KERNELS[kernel]
        body = getattr(importlib.import_module(f"gpusense.reference.{row.file}"), kernel)
        real = np.dtype(np.float64 if "FLOAT64" in flags else np.float32)
        taken = row.with_flags(flags).arguments
        # The reference does not read these.
        absent = {one.name: _nothing(one, real) for one in row.arguments if one not in taken}

        def launch(size: tuple[int, ...], *arguments: Any) -> None:
            pairs = zip(taken, arguments, strict=True)
            bound = absent | {one.name: _bound(one, value, real) for one, value in pairs}
            with np.errstate(all="ignore"):
                body(flags, *[bound[one.name] for one in row.arguments])

        return launch

    def source(self, kernel: str, flags: frozenset[str]) -> str:
        """See Backend.source; flags are arguments of the reference."""
        return inspect.getsource(importlib.import_module(f"gpusense.reference.{KERNELS[kernel].file}"))

    def synchronize(self) -> None:
        """See Backend.synchronize."""


# ---- NumPy as a library of the registry; its one device is the host


class NumpyLibrary(Library):
    """One device: the host."""

    def list_devices(self) -> list[tuple[BackendInfo, None]]:
        return [(describe(), None)]

    def open(self, info: BackendInfo, handle: None) -> Backend:
        return NumpyBackend(info)


LIBRARY = NumpyLibrary()
