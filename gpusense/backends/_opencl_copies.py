"""Copies of one call to and from a device that is far from the host, by way of page-locked memory.

A copy from or to memory that the driver has not locked waits for a copy on the host, and pyopencl waits for each copy
whose event nobody keeps. So small arrays are put side by side into locked memory, and sent by one command before the
next launch: where they arrive they are parts of one buffer. Results are read into locked memory, the last one by the
command that waits for all others.
"""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import pyopencl as cl

# Bytes of a call each way, and the largest array that takes this way.
_MEMORY = 4 << 20
_LARGEST = 256 << 10
# Parts of the buffer that are kept.
_MOST_PARTS = 1024


def locked(context: cl.Context, queue: cl.CommandQueue) -> np.ndarray:
    """Page-locked memory of the host, for as long as the array lives."""
    buffer = cl.Buffer(context, cl.mem_flags.READ_WRITE | cl.mem_flags.ALLOC_HOST_PTR, _MEMORY)
    both: Any = cl.map_flags.READ | cl.map_flags.WRITE
    found: Any = cl.enqueue_map_buffer(queue, buffer, both, 0, (_MEMORY,), np.dtype(np.uint8))
    array: np.ndarray = found[0]
    return array


class Staging:
    """What one call copies."""

    def __init__(self, context: cl.Context, queue: cl.CommandQueue, alignment: int) -> None:
        self._queue, self._alignment = queue, max(alignment, 256)
        self._there = cl.Buffer(context, cl.mem_flags.READ_WRITE, _MEMORY)
        self._up, self._down = locked(context, queue), locked(context, queue)
        self._parts: dict[tuple[int, int], cl.Buffer] = {}
        self.begin()

    def begin(self) -> None:
        """A new call's; the device has done everything."""
        # Bytes that are taken on the way there, of these that are sent, and on the way back.
        self._taken = self._sent = self._back = 0
        # The last result, which is not yet asked for, and where results are to go.
        self._last: tuple[cl.Buffer, np.ndarray] | None = None
        self._results: list[tuple[np.ndarray, np.ndarray]] = []
        # False while the device may still read or write.
        self.settled = True
        self._events: list[Any] = []

    def upload(self, array: np.ndarray) -> cl.Buffer | None:
        """Where a copy of an array, which may change at once, will be before the next launch; None without room."""
        size, first = array.nbytes, self._taken
        if size > _LARGEST or first + size > _MEMORY:
            return None
        self._up[first : first + size] = array.reshape(-1).view(np.uint8)
        self._taken = first + -(-size // self._alignment) * self._alignment
        part = self._parts.get((first, size))
        if part is None:
            if len(self._parts) >= _MOST_PARTS:
                self._parts.clear()
            # Kernels read vectors of up to 32 bytes.
            part = self._parts[first, size] = self._there.get_sub_region(first, -(-size // 32) * 32)
        return part

    def download(self, buffer: cl.Buffer, out: np.ndarray) -> bool:
        """Ask for a result, after all that was started before, where there is room; ``deliver`` fills the array."""
        size = out.nbytes
        if size > _LARGEST or self._back + size > _MEMORY:
            return False
        self.start()
        view = self._down[self._back : self._back + size]
        self._back += -(-size // self._alignment) * self._alignment
        self._last = (buffer, view)
        self._results.append((out.reshape(-1).view(np.uint8), view))
        return True

    def start(self) -> None:
        """Send what must be there, and ask for what must be read, before another command."""
        if self._sent < self._taken:
            some = slice(self._sent, self._taken)
            self._sent, self.settled = self._taken, False
            copy = cl.enqueue_copy(self._queue, self._there, self._up[some], dst_offset=some.start, is_blocking=False)
            self._events.append(copy)
        if self._last is not None:
            self._read(blocking=False)

    def wait(self) -> bool:
        """Wait for everything, if there is a result to wait for; say whether there was."""
        if self._last is None:
            return False
        last, self._last = self._last, None
        self.start()
        self._last = last
        self._read(blocking=True)
        return True

    def deliver(self) -> None:
        """Fill the arrays of results; the device has done everything."""
        for out, view in self._results:
            out[:] = view
        self._results.clear()
        self._events.clear()
        # What was sent stays where it is until the call ends.
        self._back, self.settled = 0, True

    def _read(self, blocking: bool) -> None:
        assert self._last is not None
        (buffer, view), self._last = self._last, None
        self.settled = False
        event = cl.enqueue_copy(self._queue, view, buffer, is_blocking=blocking)
        if not blocking:
            self._events.append(event)


class Stagings:
    """Of each thread of a call its own, and those that no call has now."""

    def __init__(self, context: cl.Context, queue: cl.CommandQueue, alignment: int) -> None:
        self._arguments = (context, queue, alignment)
        self._thread = threading.local()
        self._free: list[Staging] = []

    def own(self) -> Staging | None:
        """That of the call that this thread is in."""
        return getattr(self._thread, "staging", None)

    def begin(self) -> Staging:
        """A call begins; what its staging did before may not have ended."""
        try:
            staging = self._free.pop()
        except IndexError:
            staging = Staging(*self._arguments)
        self._thread.staging = staging
        return staging

    def end(self) -> None:
        """The call has ended."""
        staging = self.own()
        if staging is not None:
            self._thread.staging = None
            self._free.append(staging)
