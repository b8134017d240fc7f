"""What a backend is: six verbs and no science.

``upload``, ``empty``, ``download``, ``compile``, ``synchronize``, ``info``. A buffer is whatever the backend makes of
it; models only pass buffers on. Kernels are asked for by name and flags, and are bound by the signature table.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

Buffer = Any


@dataclass(frozen=True)
class BackendInfo:
    """A device as a model sees it.

    Attributes:
        selection: What selects this device again, such as ``"opencl:0:0"``.
        backend: ``"numpy"``, ``"opencl"`` or ``"warp"``.
        name: The device's own name.
        kind: ``"cpu"`` or ``"gpu"``.
        driver: Version of the driver or library that compiles for it.
        memory: Bytes of device memory.
        max_buffer: Bytes of the largest buffer.
        float64: Whether float64 kernels exist on it.
        lanes: 1 leaves it to the compiler to compute several particles or beams at once, more asks for kernels that do.
        vector_loops: Whether the compiler makes vectors of a work-item's loops over readings, and not of work-items.
    """

    selection: str
    backend: str
    name: str
    kind: str
    driver: str
    memory: int
    max_buffer: int
    float64: bool
    lanes: int = 1
    vector_loops: bool = False


class ProcessBound:
    """A device that was opened in this process; drivers do not survive a fork."""

    info: BackendInfo

    def __init__(self) -> None:
        self._process = os.getpid()

    def check_process(self) -> None:
        """Refuse to work in a forked child, where the driver would hang or corrupt memory.

        Raises:
            RuntimeError: this process is not the one that opened the device.
        """
        if os.getpid() != self._process:
            raise RuntimeError(
                f"{self.info.selection} was opened by process {self._process} and does not survive a fork: start "
                "workers with multiprocessing.get_context('spawn') and make their models there"
            )


class Launcher(Protocol):
    """A compiled kernel: call it with the global size and the arguments of its row, in order."""

    def __call__(self, size: tuple[int, ...], *arguments: Any) -> None:
        """Start one launch; buffers and scalars in the order of the signature table."""


class Replay(Protocol):
    """Launches that are started again and again, with the same memory and numbers."""

    def __call__(self, stream: Any = None) -> None:
        """Start them on a stream of the device, or on its current one."""

    def wait(self) -> None:
        """Wait until all that was started has ended."""


class Gathering(Protocol):
    """What a backend may have besides, where to start things takes longer than small ones last."""

    def gather(self) -> None:
        """From now on this thread's launches and copies may wait until ``synchronize``, and are done in their order.

        Nothing else changes: what must be done at once is done at once, after all before it.
        """

    def start(self) -> None:
        """Start what still waits."""

    def scatter(self) -> None:
        """Start what still waits, and gather no more."""

    def mark(self) -> object | None:
        """Where in what this thread gathers it is now; None where it does not."""

    def kept(self, mark: object) -> object | None:
        """The launches since a mark, to be repeated; None if there was anything else. It keeps no buffer alive."""

    def repeat(self, kept: object) -> None:
        """Gather such launches once more: with the same memory and numbers."""

    def address(self, buffer: Buffer) -> int:
        """Where a buffer lies."""

    def record(self, run: Callable[[], None]) -> Replay:
        """The launches of ``run``, which starts nothing else, kept and not started. They keep no buffer alive."""


class Backend(Protocol):
    """A device that holds buffers and runs kernels."""

    @property
    def info(self) -> BackendInfo:
        """The device behind this backend."""

    def upload(self, array: np.ndarray, out: Buffer | None = None, *, wait: bool = True) -> Buffer:
        """Copy a C-contiguous array to the device, into the head of ``out`` where given.

        Without ``wait`` the array must stay as it is until ``synchronize`` has returned.
        """

    def empty(self, count: int, dtype: np.dtype, *, zero: bool = False) -> Buffer:
        """A new buffer of ``count`` numbers, cleared only where asked.

        Raises:
            MemoryError: the device cannot hold it.
        """

    def download(self, buffer: Buffer, out: np.ndarray, *, wait: bool = True) -> np.ndarray:
        """Copy the head of a buffer into a C-contiguous array, after all that was started before.

        Without ``wait`` the array must live, and is not filled, until ``synchronize`` has returned.
        """

    def part(self, buffer: Buffer, first: int, count: int) -> Buffer:
        """``count`` numbers of a buffer from number ``first`` on, without a copy."""

    def compile(self, kernel: str, flags: frozenset[str]) -> Launcher:
        """The kernel of that name, specialised by flags; compiled once and kept."""

    def synchronize(self) -> None:
        """Wait until every launch has finished."""
