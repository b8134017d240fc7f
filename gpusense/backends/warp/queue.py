"""What a call starts on a CUDA device is gathered and done in one go, as a CUDA graph where it is what was done before.

A call of few particles is short: three launches of some 3 us each. To start a launch takes Warp 5 us, to start a copy
10 us, and a copy from or to memory that is not page-locked waits besides. So copies of small arrays go by way of
page-locked memory, and a call whose launches and copies are those of an earlier one, to the last pointer and number, is
replayed from a graph: one start for all. Pointers and numbers are what a graph keeps, so equal keys are all it takes.
"""

from __future__ import annotations

import itertools
import logging
import threading
from collections.abc import Hashable, Mapping
from typing import Any, Protocol

import numpy as np
import warp as wp

_log = logging.getLogger(__name__)

# Page-locked bytes of a call, and the largest array that takes this way.
_MEMORY = 16 << 20
_LARGEST = 256 << 10
# Bytes between the beginnings of arrays there.
_ALIGNMENT = 256
# Views of that memory, graphs, and keys of calls that might become graphs, which are kept.
_MOST_VIEWS, _MOST_GRAPHS, _MOST_SEEN = 1024, 256, 512
# A graph makes room for another when so many calls have not used it, in multiples of the graphs that there may be: to
# make one takes longer than what it stands for.
_STALE = 16
# Beyond this a call is long enough for its starts not to count.
_MOST_STEPS = 64
# How the threads that share launches on the processor are called.
HELPERS = "gpusense pieces"


class Step(Protocol):
    """A launch or a copy."""

    @property
    def key(self) -> Hashable:
        """What it does, and to which memory: steps of equal keys are the same."""

    def start(self, stream: wp.Stream | None) -> None:
        """Start it on a stream, or on the device's current one."""


class Copy:
    """A copy of the first numbers of an array into another."""

    def __init__(self, target: wp.array, source: wp.array, count: int) -> None:
        self._arguments = (target, source, count)
        self.key: Hashable = (target.ptr, source.ptr, count)

    def start(self, stream: wp.Stream | None) -> None:
        """See Step.start."""
        target, source, count = self._arguments
        wp.copy(target, source, count=count, stream=stream)


class Queue:
    """What one call has gathered."""

    def __init__(self, device: wp.Device, types: Mapping[Any, Any]) -> None:
        self.steps: list[Step] = []
        # False while the device may still read or write the page-locked memory.
        self.settled = True
        self._types = types
        self._memory = wp.empty(_MEMORY, dtype=wp.uint8, device="cpu", pinned=device.is_cuda)
        self._bytes = self._memory.numpy()
        self._used = 0
        self._views: dict[tuple[int, int, np.dtype], tuple[np.ndarray, wp.array]] = {}
        # What came back, and where it is to go.
        self._back: list[tuple[np.ndarray, np.ndarray]] = []

    def begin(self) -> None:
        """Gather a new call's; the device has done everything."""
        self.settled, self._used = True, 0
        self._back.clear()

    def upload(self, array: np.ndarray, out: wp.array) -> bool:
        """Gather a copy to the device, where there is room; the array may change at once."""
        room = self._room(array)
        if room is None:
            return False
        room[0][...] = array.reshape(-1)
        self.steps.append(Copy(out, room[1], array.size))
        return True

    def download(self, buffer: wp.array, out: np.ndarray) -> bool:
        """Gather a copy from the device, where there is room; the array is filled by ``deliver``."""
        room = self._room(out)
        if room is None:
            return False
        self.steps.append(Copy(room[1], buffer, out.size))
        self._back.append((out.reshape(-1), room[0]))
        return True

    def deliver(self) -> None:
        """Fill the arrays of downloads; the device has done everything."""
        self.settled, self._used = True, 0
        for out, found in self._back:
            out[...] = found
        self._back.clear()

    def _room(self, array: np.ndarray) -> tuple[np.ndarray, wp.array] | None:
        """Page-locked memory for an array, as NumPy and as Warp see it."""
        size, begin = array.nbytes, self._used
        if size > _LARGEST or begin + size > _MEMORY:
            return None
        self._used, self.settled = begin + -(-size // _ALIGNMENT) * _ALIGNMENT, False
        key = (begin, array.size, array.dtype)
        found = self._views.get(key)
        if found is None:
            if len(self._views) >= _MOST_VIEWS:
                self._views.clear()
            view = wp.array(
                ptr=self._memory.ptr + begin, dtype=self._types[array.dtype], shape=(array.size,), device="cpu"
            )
            found = self._views[key] = (self._bytes[begin : begin + size].view(array.dtype), view)
        return found


class Graphs:
    """Graphs of what was done more than once."""

    def __init__(self, device: wp.Device) -> None:
        self._device = device
        # The least recently used first, each with the number of the call that used it last.
        self._graphs: dict[Hashable, tuple[Any, int]] = {}
        self._calls = 0
        self._seen: dict[Hashable, None] = {}
        self._lock = threading.Lock()
        self._stream: wp.Stream | None = None
        # Why the driver captures no graphs; empty where it does.
        self.failure = ""

    def start(self, steps: list[Step]) -> None:
        """Start steps in their order."""
        if not 1 < len(steps) <= _MOST_STEPS or self.failure:
            _start_each(steps, None)
            return
        key = tuple([step.key for step in steps])
        # A graph must not be started by two threads at once.
        with self._lock:
            self._calls += 1
            graph, _ = self._graphs.pop(key, (None, 0))
            if graph is None and self._seen.pop(key, key) is None and self._room():
                graph = self._record(steps)
            if graph is None:
                _remember(self._seen, key, None, _MOST_SEEN)
            else:
                _remember(self._graphs, key, (graph, self._calls), _MOST_GRAPHS)
                wp.capture_launch(graph)
                return
        _start_each(steps, None)

    def recorded(self, steps: list[Step]) -> Any:
        """A graph of steps for whoever keeps it; None where there can be none now."""
        if self.failure or len(steps) < 2:
            return None
        with self._lock:
            return self._record(steps)

    def _room(self) -> bool:
        """Whether another graph may be kept."""
        if len(self._graphs) < _MOST_GRAPHS:
            return True
        _, used = next(iter(self._graphs.values()))
        return self._calls - used > _STALE * _MOST_GRAPHS

    def _record(self, steps: list[Step]) -> Any:
        """A graph of steps, none of which is started; None where there can be none now.

        While one thread records, Warp refuses to let others wait for the device: only a thread alone does. Those that
        share launches on the processor wait for no device.
        """
        if sum(not thread.name.startswith(HELPERS) for thread in threading.enumerate()) > 1:
            return None
        try:
            if self._device.is_cuda and self._stream is None:
                self._stream = wp.Stream(self._device)
            where = {"stream": self._stream} if self._device.is_cuda else {"device": self._device}
            wp.capture_begin(**where, force_module_load=False)
            try:
                _start_each(steps, self._stream)
            finally:
                graph = wp.capture_end(**where)
        except RuntimeError as error:
            # A driver that cannot: every step is started on its own from now on.
            self.failure = str(error)
            _log.warning("%s captures no CUDA graph, so launches are started one by one: %s", self._device, error)
            return None
        return graph


class Recorded:
    """A recording: steps that belong together, and are one step to a call that gathers them.

    They are a graph as soon as there can be one.
    """

    _numbers = itertools.count()

    def __init__(self, device: wp.Device, graphs: Graphs, steps: list[Step]) -> None:
        self._device, self._graphs, self._steps = device, graphs, steps
        self.key: Hashable = next(self._numbers)
        self._graph: Any = None
        # Whether they were started, each on its own, which loads what a graph must not wait for.
        self._begun = False
        self._streams: dict[int, wp.Stream] = {}
        # The streams on which they were started since the last wait; the processor has none.
        self._used: set[wp.Stream | None] = set()
        self._lock = threading.Lock()

    def start(self, stream: wp.Stream | None) -> None:
        """See Step.start."""
        _start_each(self._steps, stream)

    def __call__(self, stream: Any = None) -> None:
        """See Recording.__call__."""
        if stream is None:
            where = self._device.stream if self._device.is_cuda else None
        else:
            where = self._stream(stream)
        # A graph must not be started by two threads at once.
        with self._lock:
            self._used.add(where)
            graph = self._graph
            if graph is None and self._begun:
                graph = self._graph = self._graphs.recorded(self._steps)
            if graph is None:
                self._begun = True
                _start_each(self._steps, where)
            else:
                wp.capture_launch(graph, where)

    def wait(self) -> None:
        """See Recording.wait."""
        used, self._used = self._used, set()
        for stream in used:
            if stream is not None:
                wp.synchronize_stream(stream)

    def _stream(self, given: Any) -> wp.Stream:
        """A stream of any library as Warp knows it."""
        if isinstance(given, wp.Stream):
            return given
        address = given
        for name in ("cuda_stream", "ptr"):
            address = getattr(given, name, address)
        if not isinstance(address, int) or not self._device.is_cuda:
            raise TypeError(f"stream: must be a stream of {self._device}, got {given!r}")
        found = self._streams.get(address)
        if found is None:
            found = self._streams[address] = wp.Stream(self._device, cuda_stream=address)
        return found


def _start_each(steps: list[Step], stream: wp.Stream | None) -> None:
    for step in steps:
        step.start(stream)


def _remember(kept: dict[Hashable, Any], key: Hashable, value: Any, most: int) -> None:
    """Keep a value as the newest of at most so many."""
    kept[key] = value
    if len(kept) > most:
        del kept[next(iter(kept))]
