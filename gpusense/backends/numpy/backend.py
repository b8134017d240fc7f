"""The NumPy reference as a backend: buffers are arrays, kernels are the functions of ``gpusense.reference``."""

from __future__ import annotations

import importlib
import inspect
from typing import Any

import numpy as np

from gpusense.backends.base import Backend, Launcher
from gpusense.backends.info import BackendInfo
from gpusense.backends.processor import host_memory
from gpusense.interface import structs
from gpusense.interface.signatures import KERNELS


def describe() -> BackendInfo:
    """Describe the host as a device."""
    memory = host_memory()
    return BackendInfo("numpy", "numpy", "NumPy reference", "cpu", np.__version__, memory, memory, True)


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

        def launch(size: tuple[int, ...], *arguments: Any) -> None:
            bound: list[Any] = []
            for declared, value in zip(row.arguments, arguments, strict=True):
                if declared.is_struct:
                    bound.append(structs.rounded(value, declared.type, real))
                elif declared.shape is None:
                    dtype = declared.dtype(real)
                    bound.append(int(value) if dtype.kind == "i" else dtype.type(value))
                else:
                    bound.append(declared.shaped(value))
            with np.errstate(all="ignore"):
                body(flags, *bound)

        return launch

    def source(self, kernel: str, flags: frozenset[str]) -> str:
        """See Backend.source; flags are arguments of the reference."""
        return inspect.getsource(importlib.import_module(f"gpusense.reference.{KERNELS[kernel].file}"))

    def synchronize(self) -> None:
        """See Backend.synchronize."""
