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
        target: The processor for which the driver compiles, by its compiler's name; empty where it is not known.
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
    target: str = ""


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


@dataclass(frozen=True)
class Adopted:
    """An array of another library that lies in a device's memory, without a copy.

    Attributes:
        buffer: Its numbers; only of a C-contiguous array.
        shape: Its shape.
        dtype: Type of its numbers.
        strides: Bytes from one number to the next along each axis.
        contiguous: Whether it is C-contiguous.
        to_host: Copies it, after all that was started before.
        owner: What keeps the memory alive.
    """

    buffer: Buffer
    shape: tuple[int, ...]
    dtype: np.dtype
    strides: tuple[int, ...]
    contiguous: bool
    to_host: Callable[[], np.ndarray]
    owner: object


class Sharing(Protocol):
    """What a backend may have besides, where other libraries have arrays in its memory.

    Attributes:
        alignment: Parts of buffers begin at multiples of so many bytes.
    """

    alignment: int

    def adopt(self, array: Any, name: str, *, in_place: bool = False) -> Adopted:
        """An array of another library as it is; one that the device cannot begin with is copied unless ``in_place``.

        Raises:
            TypeError: it is not in this device's memory, or does not hold numbers.
            ValueError: it must be used in place, and cannot.
        """

    def blank(self, count: int, dtype: np.dtype) -> Buffer:
        """A buffer of ``count`` numbers, of any kind but shared with the host, that can be lent; it may hold none."""

    def copy(self, source: Buffer, target: Buffer, size: int, *, begin: int = 0, to: int = 0) -> None:
        """Start to copy ``size`` bytes of a buffer from byte ``begin`` on into another, from byte ``to`` on."""

    def lend(self, buffer: Buffer, shape: tuple[int, ...], dtype: np.dtype) -> object:
        """A buffer as an array of the library that the backend is made with."""


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


class Recording(Protocol):
    """What a backend has besides that can start launches again without binding their arguments anew."""

    @property
    def stages(self) -> bool:
        """Whether calls of few particles gain by it although their arrays must be copied to the device and back."""

    def record(self, run: Callable[[], None]) -> Replay:
        """The launches of ``run``, which starts nothing else, kept and not started; buffers are kept by who calls."""


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

    def part(self, buffer: Buffer, first: int, count: int, dtype: np.dtype) -> Buffer:
        """``count`` numbers of a buffer, which may be of another type, from number ``first`` on, without a copy.

        Raises:
            ValueError: the device cannot begin there; see Sharing.alignment.
        """

    def compile(self, kernel: str, flags: frozenset[str]) -> Launcher:
        """The kernel of that name, specialised by flags; compiled once and kept."""

    def synchronize(self) -> None:
        """Wait until every launch has finished."""
