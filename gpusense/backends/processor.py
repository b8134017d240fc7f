"""The host: its instruction sets, memory and fingerprint, and threads that share its part of large work."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import platform
import sys
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from concurrent.futures import Future, ThreadPoolExecutor

_CPUINFO = "/proc/cpuinfo"


@functools.cache
def instruction_sets() -> frozenset[str]:
    """Return the instruction sets of the processor by Linux's names, such as ``avx2``; empty on other systems."""
    return frozenset(_fields().get("flags", "").split())


@functools.cache
def fingerprint() -> str:
    """Return a text that differs between processors for which a compiler may make different code."""
    fields = _fields()
    names = ("vendor_id", "cpu family", "model", "model name", "stepping")
    parts = [platform.machine(), platform.processor(), *(fields.get(name, "") for name in names)]
    parts.append(" ".join(sorted(instruction_sets())))
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def host_memory() -> int:
    """Return the bytes of the host's memory; 4 GiB where the system does not say."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, OSError, ValueError):
        return 4 << 30


@functools.cache
def _fields() -> dict[str, str]:
    """Return the fields of Linux's list; the first processor sets a repeated field."""
    try:
        with open(_CPUINFO, encoding="utf-8", errors="replace") as file:
            text = file.read(1 << 16)
    except OSError:
        return {}
    lines = (line.partition(":") for line in reversed(text.splitlines()))
    return {name.strip(): value.strip() for name, _, value in lines}


def name() -> str:
    """Return the processor's name as the operating system reports it."""
    fields = _fields()
    named = next((fields[key] for key in ("model name", "Model", "Hardware") if fields.get(key)), "")
    if sys.platform == "darwin":
        import subprocess

        with contextlib.suppress(OSError, subprocess.SubprocessError):
            command = ["/usr/sbin/sysctl", "-n", "machdep.cpu.brand_string"]
            named = subprocess.run(command, capture_output=True, text=True, check=True, timeout=5).stdout.strip()
    return named or platform.processor() or platform.machine() or "unknown processor"


# ---- threads that share the host's part of large work: launches on the processor, copies, and bounds of poses


# Prefix of the names of the threads. They never wait for a device.
HELPERS = "gpusense pieces"


@functools.cache
def threads() -> int:
    """Return the number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@functools.cache
def pool(process: int) -> ThreadPoolExecutor:
    """Return the threads of a process, one fewer than it has processors: the calling thread also works."""
    # Calls of few particles, and most processes, need no threads.
    from concurrent.futures import ThreadPoolExecutor

    return ThreadPoolExecutor(max(threads() - 1, 1), HELPERS)


def finish(helpers: Sequence[Future[Any]]) -> None:
    """Cancel helpers that have not begun, and wait for running helpers even when interrupted."""
    if not helpers:
        return
    from concurrent.futures import wait

    interrupted: BaseException | None = None
    for helper in helpers:
        helper.cancel()
    while any(not helper.done() for helper in helpers):
        try:
            wait(helpers)
        except KeyboardInterrupt as error:
            interrupted = error
    if interrupted is not None:
        raise interrupted


# ---- large copies between host arrays and a GPU: in pieces, through page-locked memory, by several threads
#
# A driver copies ordinary host memory with one thread, at a fraction of the speed at which the device reads and writes
# page-locked memory. Threads also share the page faults of new results.


# Size of a slot [bytes], number of slots, and number of slots that threads fill or empty while the device works on the
# rest.
SLOT, SLOTS, _AHEAD = 4 << 20, 16, 12
# Least sizes of a copy for which pieces pay, and of a piece [bytes]; pieces of a copy that needs no more slots:
# each piece costs the calling thread some 0.05 ms.
LEAST, _LEAST_PIECE, _FEWEST = 8 << 20, 1 << 20, 6
# Threads below which a driver's own copy is faster.
_LEAST_THREADS = 4


class Slot(ABC):
    """A piece of page-locked memory."""

    bytes: np.ndarray  # the memory as an array of the host

    @abstractmethod
    def to_device(self, buffer: Any, first: int, size: int) -> None:
        """Start copying ``size`` bytes of the slot into a buffer, from its byte ``first`` on."""

    @abstractmethod
    def to_host(self, buffer: Any, first: int, size: int) -> None:
        """Start copying ``size`` bytes of a buffer, from its byte ``first`` on, into the slot."""

    @abstractmethod
    def wait(self) -> None:
        """Wait until the last copy of the slot has ended."""


class Staging:
    """Slots of a device, which serve one copy at a time; ``make`` allocates them when they are needed first."""

    def __init__(self, make: Callable[[int, int], Sequence[Slot]]) -> None:
        self._make, self._slots = make, list[Slot]()
        self._lock = threading.Lock()

    def upload(self, array: np.ndarray, buffer: Any) -> bool:
        """Copy an array, which may change afterwards, to a buffer; return False if a plain copy is faster."""
        return self._run(array, buffer, _send)

    def download(self, buffer: Any, out: np.ndarray) -> bool:
        """Copy the head of a buffer into an array, full on return; return False if a plain copy is faster."""
        return self._run(out, buffer, _receive)

    def _run(self, array: np.ndarray, buffer: Any, copy: Callable[..., None]) -> bool:
        """Copy an array by a function, if that pays and no other thread uses the slots."""
        if array.nbytes < LEAST or threads() < _LEAST_THREADS or not self._lock.acquire(blocking=False):
            return False
        started: list[Future[None]] = []
        try:
            if not self._slots:
                self._slots = list(self._make(SLOTS, SLOT))
            copy(self._slots, array.reshape(-1).view(np.uint8), buffer, started)
        finally:
            # No thread may use slots or array any more, not even after an error.
            try:
                finish(started)
            finally:
                self._lock.release()
        return True


def _pieces(size: int) -> list[tuple[int, int]]:
    """Return the first byte and the bytes of each piece."""
    piece = min(max(-(-size // _FEWEST), _LEAST_PIECE), SLOT)
    return [(first, min(piece, size - first)) for first in range(0, size, piece)]


def _send(slots: Sequence[Slot], source: np.ndarray, buffer: Any, started: list[Any]) -> None:
    """Copy an array to a device."""
    workers, pieces = pool(os.getpid()), _pieces(source.size)

    def fill(number: int) -> None:
        (first, size), slot = pieces[number], slots[number % len(slots)]
        slot.wait()
        started.append(workers.submit(np.copyto, slot.bytes[:size], source[first : first + size]))

    for number in range(1, min(_AHEAD, len(pieces))):
        fill(number)
    # The calling thread also works.
    slots[0].wait()
    np.copyto(slots[0].bytes[: pieces[0][1]], source[: pieces[0][1]])
    for number, (first, size) in enumerate(pieces):
        if number + _AHEAD < len(pieces):
            fill(number + _AHEAD)
        if number:
            started[number - 1].result()
        slots[number % len(slots)].to_device(buffer, first, size)


def _receive(slots: Sequence[Slot], out: np.ndarray, buffer: Any, started: list[Any]) -> None:
    """Copy from a device to an array."""
    workers, pieces = pool(os.getpid()), _pieces(out.size)
    for slot, piece in zip(slots, pieces, strict=False):
        # The device may still read what an earlier call has sent.
        slot.wait()
        slot.to_host(buffer, *piece)
    for number, (first, size) in enumerate(pieces):
        slot = slots[number % len(slots)]
        slot.wait()
        started.append(workers.submit(np.copyto, out[first : first + size], slot.bytes[:size]))
        # The slot of an earlier piece takes a later one.
        emptied = number - _AHEAD
        if emptied >= 0 and emptied + len(slots) < len(pieces):
            started[emptied].result()
            slots[emptied % len(slots)].to_host(buffer, *pieces[emptied + len(slots)])
    for helper in started:
        helper.result()
