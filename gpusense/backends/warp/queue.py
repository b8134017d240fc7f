"""Launches and copies of a call, which wait in a queue and are started together.

A call of few particles is short: three launches of about 3 us each. Warp takes 5 us to start a launch and 10 us to
start a copy, and a copy from or to pageable memory also waits. Therefore small arrays are copied through page-locked
memory, and a call that repeats an earlier one is started as a CUDA graph; see :mod:`.graphs`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Hashable, Mapping, Sequence
from typing import Any

import numpy as np
import warp as wp

from gpusense.backends.base import pluralize

# Page-locked memory of a call, and the largest array that is copied through it [bytes].
_MEMORY = 16 << 20
_LARGEST = 256 << 10
# Alignment of arrays in that memory [bytes].
_ALIGNMENT = 256
# Number of views of that memory that are kept.
_MOST_VIEWS = 1024


class CallQueue:
    """The steps of one call that wait to be started, and page-locked memory for its copies.

    ``settled``: False while the device may still read or write that memory.
    """

    def __init__(self, device: wp.Device, types: Mapping[Any, Any]) -> None:
        self.steps: list[Step] = []
        self.settled = True
        self._types = types
        self._memory = wp.empty(_MEMORY, dtype=wp.uint8, device="cpu", pinned=device.is_cuda)
        self._bytes = self._memory.numpy()
        self._used = 0
        self._views: dict[tuple[int, int, np.dtype], tuple[np.ndarray, wp.array]] = {}
        # Targets of downloads, each with its page-locked source.
        self._downloads: list[tuple[np.ndarray, np.ndarray]] = []

    def begin(self) -> None:
        """Begin a new call; the device must have ended all work."""
        self.settled, self._used = True, 0
        self._downloads.clear()

    def upload(self, array: np.ndarray, out: wp.array) -> bool:
        """Enqueue a copy to the device, after which the array may change; return whether there is room for it."""
        room = self._room(array)
        if room is None:
            return False
        room[0][...] = array.reshape(-1)
        self.steps.append(Copy(out, room[1], array.size))
        return True

    def download(self, buffer: wp.array, out: np.ndarray) -> bool:
        """Enqueue a copy from the device, which ``deliver`` completes; return whether there is room for it."""
        room = self._room(out)
        if room is None:
            return False
        self.steps.append(Copy(room[1], buffer, out.size))
        self._downloads.append((out.reshape(-1), room[0]))
        return True

    def deliver(self) -> None:
        """Fill the arrays of downloads; the device must have ended all work."""
        self.settled, self._used = True, 0
        for out, source in self._downloads:
            out[...] = source
        self._downloads.clear()

    def _room(self, array: np.ndarray) -> tuple[np.ndarray, wp.array] | None:
        """Return page-locked memory for an array, as NumPy's and as Warp's; None where there is not enough."""
        size, begin = array.nbytes, self._used
        if size > _LARGEST or begin + size > _MEMORY:
            return None
        self._used, self.settled = begin + -(-size // _ALIGNMENT) * _ALIGNMENT, False
        key = (begin, array.size, array.dtype)
        room = self._views.get(key)
        if room is None:
            if len(self._views) >= _MOST_VIEWS:
                self._views.clear()
            view = wp.array(
                ptr=self._memory.ptr + begin, dtype=self._types[array.dtype], shape=(array.size,), device="cpu"
            )
            room = self._views[key] = (self._bytes[begin : begin + size].view(array.dtype), view)
        return room


# ---- steps of a call on a Warp device: launches, copies and recordings, which can wait to be started


class Step(ABC):
    """Work that a stream does."""

    key: Hashable  # the work and its memory: steps of equal keys are the same
    launches: int = 0  # number of launches in it
    copies: int = 0  # number of copies in it

    @abstractmethod
    def start(self, stream: wp.Stream | None) -> None:
        """Start it on a stream, or on the device's current one."""

    def replay(self) -> None:
        """Start it on the device's current stream, as a graph where it has one."""
        self.start(None)


class Copy(Step):
    """A copy of the first numbers of an array into another."""

    copies = 1

    def __init__(self, target: wp.array, source: wp.array, count: int) -> None:
        self._arguments = (target, source, count)
        self.key = (target.ptr, source.ptr, count, target.dtype)

    def start(self, stream: wp.Stream | None) -> None:
        target, source, count = self._arguments
        wp.copy(target, source, count=count, stream=stream)


def start_each(steps: Sequence[Step], stream: wp.Stream | None) -> None:
    """Start steps singly, in order."""
    for step in steps:
        step.start(stream)


def contents(steps: Sequence[Step]) -> str:
    """Return the launches and copies of steps in words: ``"3 launches and 2 copies"``."""
    launches = pluralize(sum(step.launches for step in steps), "launch")
    copies = sum(step.copies for step in steps)
    return f"{launches} and {pluralize(copies, 'copy')}" if copies else launches


def as_graph(steps: Sequence[Step]) -> str:
    """Return in words that steps are started as one graph."""
    return f"one CUDA graph of {contents(steps)}"


def one_by_one(steps: Sequence[Step], reason: str) -> str:
    """Describe that steps are started singly, and why."""
    return f"{contents(steps)} one by one: {reason}"
