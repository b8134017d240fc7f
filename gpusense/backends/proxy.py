"""A backend that forwards every method to another one."""

from __future__ import annotations

from typing import Any

import numpy as np

from gpusense.backends.base import Adopted, Backend, Buffer, Launcher
from gpusense.backends.info import BackendInfo


class Proxy(Backend):
    """Base of backends that watch or count: it forwards every method to another backend.

    Launches of programs and recordings all go through ``compile``, so a subclass that overrides it sees each launch.
    """

    def __init__(self, backend: Backend) -> None:
        self._backend = backend

    @property
    def info(self) -> BackendInfo:  # type: ignore[override]
        """See Backend."""
        return self._backend.info

    @property
    def alignment(self) -> int:  # type: ignore[override]
        """See Backend."""
        return self._backend.alignment

    def upload(self, array: np.ndarray, out: Buffer | None = None, *, wait: bool = True) -> Buffer:
        """See Backend.upload."""
        return self._backend.upload(array, out, wait=wait)

    def empty(self, count: int, dtype: np.dtype, *, zero: bool = False) -> Buffer:
        """See Backend.empty."""
        return self._backend.empty(count, dtype, zero=zero)

    def download(self, buffer: Buffer, out: np.ndarray, *, wait: bool = True) -> np.ndarray:
        """See Backend.download."""
        return self._backend.download(buffer, out, wait=wait)

    def empty_result(self, shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
        """See Backend.empty_result."""
        return self._backend.empty_result(shape, dtype)

    def part(self, buffer: Buffer, first: int, count: int, dtype: np.dtype) -> Buffer:
        """See Backend.part."""
        return self._backend.part(buffer, first, count, dtype)

    def compile(self, kernel: str, flags: frozenset[str]) -> Launcher:
        """See Backend.compile."""
        return self._backend.compile(kernel, flags)

    def source(self, kernel: str, flags: frozenset[str]) -> str:
        """See Backend.source."""
        return self._backend.source(kernel, flags)

    def synchronize(self) -> None:
        """See Backend.synchronize."""
        self._backend.synchronize()

    def begin_batch(self) -> None:
        """See Backend.begin_batch."""
        self._backend.begin_batch()

    def submit(self) -> None:
        """See Backend.submit."""
        self._backend.submit()

    def end_batch(self) -> None:
        """See Backend.end_batch."""
        self._backend.end_batch()

    @property
    def in_batch(self) -> bool:
        """See Backend.in_batch."""
        return self._backend.in_batch

    @property
    def replays(self) -> bool:
        """See Backend.replays."""
        return self._backend.replays

    def address(self, buffer: Buffer) -> int:
        """See Backend.address."""
        return self._backend.address(buffer)

    def check_process(self) -> None:
        """See Backend.check_process."""
        self._backend.check_process()

    def reads(self, array: object) -> bool:
        """See Backend.reads."""
        return self._backend.reads(array)

    def adopt(self, array: Any, name: str, *, in_place: bool = False) -> Adopted:
        """See Backend.adopt."""
        return self._backend.adopt(array, name, in_place=in_place)

    def view(self, buffer: Buffer, shape: tuple[int, ...], dtype: np.dtype) -> Adopted:
        """See Backend.view."""
        return self._backend.view(buffer, shape, dtype)

    def blank(self, count: int, dtype: np.dtype) -> Buffer:
        """See Backend.blank."""
        return self._backend.blank(count, dtype)

    def copy(self, source: Buffer, target: Buffer, size: int, *, begin: int = 0, to: int = 0) -> None:
        """See Backend.copy."""
        self._backend.copy(source, target, size, begin=begin, to=to)

    def copies_from(self, other: Backend) -> bool:
        """See Backend.copies_from."""
        return self._backend.copies_from(other)

    def lend(self, buffer: Buffer, shape: tuple[int, ...], dtype: np.dtype) -> object:
        """See Backend.lend."""
        return self._backend.lend(buffer, shape, dtype)
