"""A backend: a device that holds buffers and runs programs, without knowledge of models.

Buffers are opaque: models only pass them on. The signature table names the kernels. Every backend has every method;
without the ability that a method needs, the method does nothing if that is correct, or raises an error.
"""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from gpusense.backends.recycled import ResultMemory
from gpusense.interface.launches import Program

Buffer = Any


class Recording(ABC):
    """A program whose arguments are bound: it is started repeatedly with the same memory and numbers."""

    @abstractmethod
    def __call__(self, stream: Any = None) -> None:
        """Start it on a stream of the device, or on its current one."""

    @abstractmethod
    def wait(self, *, elsewhere: bool = False) -> None:
        """Wait until all starts have ended.

        ``elsewhere``: wait only for starts on streams other than the device's current one; copies on that one follow
        its launches without a wait.
        """

    @abstractmethod
    def explain(self) -> str:
        """Return in one line how it is started: as one graph, or launch by launch with the reason."""


def pluralize(number: int, noun: str) -> str:
    """Return a number of launches or copies in words: ``"3 launches"``."""
    if number == 1:
        return f"1 {noun}"
    return f"{number} {noun[:-1]}ies" if noun.endswith("y") else f"{number} {noun}es"


class Launcher(Protocol):
    """A compiled kernel, called with the global size and the arguments of its row in order."""

    def __call__(self, size: tuple[int, ...], *arguments: Any) -> None:
        """Start one launch with buffers and scalars in the order of the signature table."""


@dataclass(slots=True, eq=False)
class Adopted:
    """An array in a device's memory: one of another library without a copy, or the head of a buffer."""

    buffer: Buffer  # its numbers; only of a C-contiguous array
    shape: tuple[int, ...]
    dtype: np.dtype  # type of its numbers
    to_host: Callable[[], np.ndarray]  # function that copies it to the host, after all earlier work
    owner: object  # the object that keeps the memory alive
    # Bytes from one number to the next along each axis; None if the array is C-contiguous.
    strides: tuple[int, ...] | None = None

    @property
    def contiguous(self) -> bool:
        """True if it is C-contiguous."""
        return self.strides is None


class Backend(ABC):
    """A device that holds buffers and runs programs."""

    info: BackendInfo  # the device behind this backend
    alignment: int = 1  # parts of buffers begin at multiples of this number of bytes
    # Memory of freed results on the host; None where a new array costs less.
    results: ResultMemory | None = None

    # ---- buffers and copies

    @abstractmethod
    def upload(self, array: np.ndarray, out: Buffer | None = None, *, wait: bool = True) -> Buffer:
        """Copy a C-contiguous array to the device, into the beginning of ``out`` if that is not None.

        If ``wait`` is false, the array must not change until ``synchronize`` has returned.
        """

    def refill(self, array: np.ndarray, buffer: Buffer) -> None:
        """Start copying an array into the beginning of a buffer that no unfinished work uses.

        The array must not change until ``synchronize`` has returned.
        """
        self.upload(array, buffer, wait=False)

    @abstractmethod
    def empty(self, count: int, dtype: np.dtype, *, zero: bool = False) -> Buffer:
        """Allocate a buffer of ``count`` numbers, cleared with ``zero``."""

    @abstractmethod
    def download(self, buffer: Buffer, out: np.ndarray, *, wait: bool = True) -> np.ndarray:
        """Copy the beginning of a buffer into a C-contiguous array, after all earlier work.

        If ``wait`` is false, the array must stay alive, and is not filled, until ``synchronize`` has returned.
        """

    @abstractmethod
    def part(self, buffer: Buffer, first: int, count: int, dtype: np.dtype) -> Buffer:
        """Return ``count`` numbers of a buffer from number ``first`` on as ``dtype``, without a copy."""

    # ---- programs

    @abstractmethod
    def compile(self, kernel: str, flags: frozenset[str]) -> Launcher:
        """Return a kernel by its name, specialised by flags; it is compiled once and cached."""

    def largest_group(self, kernel: str, flags: frozenset[str]) -> int:
        """Return the most work-items of a group of a compiled kernel that share memory; 1 where none do."""
        return 1

    @abstractmethod
    def source(self, kernel: str, flags: frozenset[str]) -> str:
        """Return the text from which ``compile`` makes a kernel."""

    @abstractmethod
    def synchronize(self) -> None:
        """Wait until every launch and copy has ended."""

    def exchange(self, inputs: Buffer, given: int, results: Buffer, taken: int, dtype: np.dtype) -> Exchange:
        """Return an exchange of ``given`` float64 inputs and ``taken`` results of a type, at the heads of buffers."""
        return Exchange(self, inputs, np.zeros(given), results, np.empty(taken, dtype))

    def run(self, program: Program) -> None:
        """Start the launches of a program in their order."""
        for one in program:
            self.compile(one.kernel, one.flags)(one.size, *one.arguments)

    def record(self, program: Program) -> Recording:
        """Bind the arguments of a program and start nothing; the caller must keep its buffers alive."""
        return _ProgramRecording(self, program)

    def replay(self, recording: Recording) -> None:
        """Start a recording as part of this thread's batch, or at once without a batch."""
        recording()

    @property
    def replays(self) -> bool:
        """Return whether to record bound calls of few particles, although a recording must copy their NumPy arrays."""
        return False

    # ---- batches: if a start takes longer than small work, the work of a call is started at once

    def begin_batch(self) -> None:  # noqa: B027
        """Defer this thread's launches and copies from now on; ``submit`` or ``synchronize`` starts them in order.

        A blocking copy first starts all deferred work, so the order of a call is preserved.
        """

    def submit(self) -> None:  # noqa: B027
        """Start the launches and copies of this thread's batch, and continue the batch."""

    def end_batch(self) -> None:  # noqa: B027
        """Start the launches and copies of this thread's batch, and end it."""

    @property
    def in_batch(self) -> bool:
        """Return whether this thread has a batch."""
        return False

    def address(self, buffer: Buffer) -> int:
        """Return a number that identifies the memory of a buffer among buffers that are alive."""
        return id(buffer)

    def check_process(self) -> None:  # noqa: B027
        """Refuse a forked child of the process that opened the device."""

    # ---- arrays of other libraries in the memory of the device

    def reads(self, array: object) -> bool:
        """Return whether a device array belongs to a library whose arrays this device may use."""
        return False

    def adopt(self, array: Any, name: str, *, in_place: bool = False) -> Adopted:
        """Return an array of another library without a copy; a misaligned one is copied unless ``in_place``."""
        raise TypeError(f"{name}: must be in host memory for {self.info.selection}, got an array on a device")

    def view(self, buffer: Buffer, shape: tuple[int, ...], dtype: np.dtype) -> Adopted:
        """Return the head of a buffer of this device as an array that models take."""

        def to_host() -> np.ndarray:
            return self.download(buffer, np.empty(shape, dtype))

        return Adopted(buffer, shape, dtype, to_host, buffer)

    def empty_external(self, count: int, dtype: np.dtype) -> Buffer:
        """Allocate a buffer of ``count`` numbers, 0 included, for an external array, in memory of the device alone."""
        return self.empty(count, dtype)

    def copy(self, source: Buffer, target: Buffer, size: int, *, begin: int = 0, to: int = 0) -> None:
        """Start copying ``size`` bytes of a buffer from byte ``begin`` on into another, from byte ``to`` on."""
        raise TypeError(f"{self.info.selection} does not copy between buffers")

    def wrap_external(self, buffer: Buffer, shape: tuple[int, ...], dtype: np.dtype) -> object:
        """Return a buffer as an array of the backend's library."""
        raise TypeError(f"{self.info.selection} does not wrap buffers")

    def ahead(self, array: object) -> Hashable:
        """Return the key of results of an array's library that may be allocated before their call; None if none may."""
        return None

    def empty_like(self, array: object, shape: tuple[int, ...], dtype: np.dtype) -> tuple[Any, Buffer] | None:
        """Return a new array of the library of a device array, with its memory as a buffer; None if it makes none."""
        return None


class _ProgramRecording(Recording):
    """A recording of a backend that binds the arguments of each start."""

    def __init__(self, backend: Backend, program: Program) -> None:
        self._backend, self._program = backend, program

    def __call__(self, stream: Any = None) -> None:
        if stream is not None:
            raise TypeError(f"stream: must be None on {self._backend.info.selection}, got {stream!r}")
        self._backend.run(self._program)

    def wait(self, *, elsewhere: bool = False) -> None:
        if not elsewhere:
            self._backend.synchronize()

    def explain(self) -> str:
        return f"{pluralize(len(self._program), 'launch')} one by one: {self._backend.info.selection} has no graphs"


class Exchange:
    """Copies around a recording: of all its inputs to the device, and of all its results to the host.

    Attributes:
        given: The inputs, to be written after ``begin``.
    """

    def __init__(self, backend: Backend, inputs: Buffer, given: np.ndarray, results: Buffer, taken: np.ndarray) -> None:
        self.given, self._backend = given, backend
        self._inputs, self._results, self._taken, self._busy = inputs, results, taken, False

    def begin(self) -> np.ndarray:
        """Return ``given``, which no unfinished copy reads."""
        if self._busy:
            self._backend.synchronize()
            self._busy = False
        return self.given

    def start(self, recording: Recording, *, between: Callable[[], None] | None = None) -> None:
        """Copy the inputs, run ``between``, and start a recording; each has only one exchange."""
        self._busy = True
        if self.given.size:
            self._backend.refill(self.given, self._inputs)
        if between is not None:
            between()
        recording()

    def finish(self) -> np.ndarray:
        """Wait for the results of the last start, and return a copy."""
        taken = self._backend.download(self._results, np.empty_like(self._taken))
        self._busy = False
        return taken

    def explain(self, recording: Recording) -> str:
        """Return in one line how a recording is started."""
        return recording.explain()


# ---- a device as models see it, and its bond to the process that opened it


@dataclass(frozen=True)
class BackendInfo:
    """A device as a model sees it.

    Attributes:
        selection: The selection string of this device, such as ``"opencl:0:0"``.
        backend: ``"numpy"``, ``"opencl"`` or ``"warp"``.
        name: The device's name.
        kind: ``"cpu"`` or ``"gpu"``.
        driver: Version of the driver or library that compiles for it.
        memory: Bytes of device memory.
        max_buffer: Bytes of the largest buffer.
        float64: Whether float64 kernels exist on it.
        lanes: Particles or beams that a work-item of kernels in lanes computes at once; 1 leaves vectors to the
            compiler.
        vector_loops: Whether the compiler vectorises a work-item's loops over readings rather than over work-items.
        target: The processor for which the driver compiles, by its compiler's name; empty where it is not known.
        graphs: True if the launches and copies of a call are a batch, replayed as one graph once it repeats.

    Example:
        >>> from gpusense.backends import get_backend
        >>> info = get_backend("numpy").info
        >>> info.selection, info.kind, info.float64, info.graphs
        ('numpy', 'cpu', True, False)
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
    graphs: bool = False


class ProcessBound:
    """A device that is bound to the process that opened it: drivers do not survive a fork."""

    info: BackendInfo

    def __init__(self) -> None:
        self._process = os.getpid()

    def check_process(self) -> None:
        """Refuse a forked child, where the driver would hang or corrupt memory."""
        if os.getpid() != self._process:
            raise RuntimeError(
                f"{self.info.selection} was opened by process {self._process} and does not survive a fork: start "
                "workers with multiprocessing.get_context('spawn') and make their models there"
            )
