"""Recordings: programs whose launches are bound, started as one graph as soon as it can be captured."""

from __future__ import annotations

import itertools
import threading
from typing import Any

import warp as wp

from gpusense.backends.base import Recording
from gpusense.backends.warp.graphs import FIRST, GraphCache
from gpusense.backends.warp.steps import Step, as_graph, one_by_one, start_each


class WarpRecording(Recording, Step):
    """Launches of a program, one step of a batch."""

    reports = True
    _numbers = itertools.count()

    def __init__(self, device: wp.Device, graphs: GraphCache, steps: list[Step]) -> None:
        self._device, self._graphs, self._steps = device, graphs, steps
        self.key = next(self._numbers)
        self.launches = sum(step.launches for step in steps)
        self._graph: Any = None
        # Whether the driver refuses a graph of these launches.
        self._refused = False
        self._started = one_by_one(steps, FIRST)
        # True once they were started singly: this loads modules, for which a capture must not wait.
        self._loaded = False
        self._streams: dict[int, wp.Stream] = {}
        # The streams on which they were started since the last wait; the processor has none.
        self._used: set[wp.Stream | None] = set()
        self._lock = threading.Lock()

    def start(self, stream: wp.Stream | None) -> None:
        start_each(self._steps, stream)

    def note(self, started: str) -> None:
        self._started = started

    def explain(self) -> str:
        return self._started

    def __call__(self, stream: Any = None) -> None:
        if stream is None:
            where = self._device.stream if self._device.is_cuda else None
        else:
            where = self._stream(stream)
        # A graph must not be started by two threads at once.
        with self._lock:
            self._used.add(where)
            if self._graph is None and self._loaded and not self._refused:
                self._capture()
            if self._graph is None:
                self._loaded = True
                start_each(self._steps, where)
            else:
                wp.capture_launch(self._graph, where)

    def wait(self, *, elsewhere: bool = False) -> None:
        used, self._used = self._used, set()
        current = self._device.stream if elsewhere and self._device.is_cuda else None
        for stream in used:
            if stream is not None and stream is not current:
                wp.synchronize_stream(stream)

    def _capture(self) -> None:
        """Capture the launches, and note the reason where there is no graph."""
        self._graph, reason, self._refused = self._graphs.capture(self._steps)
        self._started = one_by_one(self._steps, reason) if self._graph is None else as_graph(self._steps)

    def _stream(self, stream: Any) -> wp.Stream:
        """Return a stream of any library, or its address, as Warp's."""
        if isinstance(stream, wp.Stream):
            return stream
        address = stream
        for name in ("cuda_stream", "ptr"):
            address = getattr(stream, name, address)
        if not isinstance(address, int) or not self._device.is_cuda:
            raise TypeError(f"stream: must be a stream of {self._device}, got {stream!r}")
        if address not in self._streams:
            self._streams[address] = wp.Stream(self._device, cuda_stream=address)
        return self._streams[address]
