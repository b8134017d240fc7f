"""A made-up library of arrays that exports and imports NumPy's or Warp's; arrays of Warp's processor."""

from __future__ import annotations

import sys
import types
from typing import Any

import numpy as np

CPU, CUDA = 1, 2


def counted_copies(monkeypatch: Any, backend: type) -> list[tuple[str, int]]:
    """Record the bytes that a backend's class copies to the device ("up") and back ("down") from now on."""
    seen: list[tuple[str, int]] = []
    upload, download = backend.upload, backend.download

    def up(self: Any, array: np.ndarray, out: Any = None, *, wait: bool = True) -> Any:
        seen.append(("up", array.nbytes))
        return upload(self, array, out, wait=wait)

    def down(self: Any, buffer: Any, out: np.ndarray, *, wait: bool = True) -> np.ndarray:
        seen.append(("down", out.nbytes))
        return download(self, buffer, out, wait=wait)

    monkeypatch.setattr(backend, "upload", up)
    monkeypatch.setattr(backend, "download", down)
    return seen


def to_device(array: np.ndarray):
    import warp as wp

    dtype = {"float32": wp.float32, "float64": wp.float64}.get(array.dtype.name, wp.int32)
    return wp.array(array, dtype=dtype, device="cpu")


class Array:
    """Delegates DLPack to another array, and claims to be on a kind of ``device``."""

    def __init__(self, held: Any, device: int = CPU) -> None:
        self.held, self.device = held, device

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(self.held.shape)

    def __getitem__(self, i: int) -> Array:
        return Array(self.held[i], self.device)

    def __dlpack__(self, **options: Any) -> Any:
        return self.held.__dlpack__(**options)

    def __dlpack_device__(self) -> tuple[int, int]:
        return self.device, 0


class OldArray(Array):
    """Exports DLPack's first version, without a read-only flag."""

    def __dlpack__(self, stream: Any = None) -> Any:
        return self.held.__dlpack__()

    def __array__(self, dtype: Any = None, copy: Any = None) -> np.ndarray:
        return self.held


class Recorded(Array):
    """Records gradients like PyTorch's arrays, and can be neither exported nor converted to NumPy."""

    requires_grad = True

    def __dlpack__(self, **options: Any) -> Any:
        raise BufferError("Can't export tensors that require gradient, use tensor.detach()")

    def __array__(self, dtype: Any = None, copy: Any = None) -> np.ndarray:
        raise RuntimeError("Can't call numpy() on Tensor that requires grad. Use tensor.detach().numpy() instead.")

    def detach(self) -> Array:
        return Array(self.held, self.device)


def from_dlpack(held: Any) -> Array:
    return Array(held)


def installed(monkeypatch: Any) -> None:
    """Install the module ``fakelib`` with its ``from_dlpack`` and its arrays."""
    module = types.ModuleType("fakelib")
    module.from_dlpack, module.Array = from_dlpack, Array
    monkeypatch.setitem(sys.modules, "fakelib", module)
    monkeypatch.setattr(Array, "__module__", "fakelib")
    monkeypatch.setattr(OldArray, "__module__", "fakelib")
    monkeypatch.setattr(Recorded, "__module__", "fakelib")
