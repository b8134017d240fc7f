"""CUDA graphs: a call that repeats an earlier one, with equal pointers and numbers, is a single start.

A graph keeps pointers and numbers, so steps with equal keys use the first one's graph.
"""

from __future__ import annotations

import itertools
import logging
import threading
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from gpusense.backends.base import Backend, Exchange, Recording
from gpusense.backends.processor import HELPERS
from gpusense.backends.warp.arrays import stream_of
from gpusense.backends.warp.queue import Copy, Step, as_graph, one_by_one, start_each
from gpusense.backends.workspace import RepeatCache

_LOG = logging.getLogger("gpusense")

# Largest number of graphs, and calls without a graph after which it makes room for another.
_MOST_GRAPHS, _STALE = 256, 4096
# Longer calls take so long that their starts do not matter.
_MOST_STEPS = 64
# Number of consecutive failures after which no more captures are tried.
_MOST_FAILURES = 3
# Reasons for calls without a graph.
FIRST = "a graph is captured when it is started again"
SHORT = "a graph would save nothing"


class Capture(NamedTuple):
    """An attempt to capture steps."""

    graph: Any  # the graph; None where there is none
    reason: str = ""  # why there is none
    final: bool = False  # true if the driver refuses these steps, so that another attempt is useless


class GraphCache:
    """Graphs of repeated calls of one device, and captures for recordings; ``refusal``: why no more are captured."""

    def __init__(self, device: wp.Device) -> None:
        self.refusal = ""
        self._device = device
        # By the keys of steps; a capture without a graph was refused by the driver.
        self._graphs = RepeatCache[Capture](_MOST_GRAPHS, 1, _STALE)
        self._failures = 0
        self._lock = threading.Lock()
        self._stream: wp.Stream | None = None

    def start(self, steps: list[Step]) -> None:
        """Start the steps of a call in their order."""
        if 1 < len(steps) <= _MOST_STEPS and (self._graphs or not self.refusal):
            key = tuple([step.key for step in steps])
            # A graph must not be started by two threads at once.
            with self._lock:
                capture = self._graphs.found(key, lambda: self._captured(steps))
                if capture is not None and capture.graph is not None:
                    wp.capture_launch(capture.graph)
                    return
        for step in steps:
            step.replay()

    def capture(self, steps: list[Step]) -> Capture:
        """Capture the steps of a recording and start none of them."""
        if len(steps) < 2:
            return Capture(None, SHORT, True)
        with self._lock:
            return self._capture(steps)

    def _captured(self, steps: list[Step]) -> Capture | None:
        """Return a capture of a call; None if another attempt may succeed."""
        capture = self._capture(steps)
        return capture if capture.final or capture.graph is not None else None

    def _capture(self, steps: list[Step]) -> Capture:
        """Capture steps if nothing prevents it.

        During a capture Warp refuses to let other threads wait for the device, so only a thread that is alone captures.
        Threads that share launches on the processor wait for no device.
        """
        if self.refusal:
            return Capture(None, self.refusal, True)
        if others := _other_threads():
            return Capture(None, f"another thread is alive: {', '.join(others)}")
        try:
            graph = self._captured_graph(steps)
        except RuntimeError as error:
            return self._failed(str(error))
        self._failures = 0
        return Capture(graph)

    def _captured_graph(self, steps: list[Step]) -> Any:
        """Return the graph of steps."""
        if self._device.is_cuda and self._stream is None:
            self._stream = wp.Stream(self._device)
        where = {"stream": self._stream} if self._device.is_cuda else {"device": self._device}
        wp.capture_begin(**where, force_module_load=False)
        try:
            start_each(steps, self._stream)
        finally:
            graph = wp.capture_end(**where)
        return graph

    def _failed(self, error: str) -> Capture:
        """Give up the graph of some steps, and after several failures in a row all graphs."""
        self._failures += 1
        reason = f"the driver captured no graph: {error}"
        if self._failures >= _MOST_FAILURES:
            reason = self.refusal = f"no graph is captured after {self._failures} failures in a row: {error}"
        _LOG.warning("gpusense: launches on %s are started one by one: %s", self._device, reason)
        return Capture(None, reason, True)


def _other_threads() -> list[str]:
    """Return the names of threads that may wait for the device."""
    this = threading.current_thread()
    return [one.name for one in threading.enumerate() if one is not this and not one.name.startswith(HELPERS)]


# ---- recordings: programs whose launches are bound, started as one graph as soon as it can be captured


class WarpRecording(Recording, Step):
    """Launches of a program, one step of a batch."""

    _numbers = itertools.count()

    def __init__(self, device: wp.Device, graphs: GraphCache, steps: list[Step]) -> None:
        self._device, self._graphs, self._steps = device, graphs, steps
        self.key = next(self._numbers)
        self.launches, self.copies = sum(step.launches for step in steps), sum(step.copies for step in steps)
        self._graph: Any = None
        # Whether the driver refuses a graph of these launches.
        self._refused = False
        self._started = one_by_one(steps, FIRST)
        # True once they were started singly: this loads modules, for which a capture must not wait.
        self._loaded = False
        # The recording with copies of its exchange.
        self.exchanged: WarpRecording | None = None
        # The streams on which they were started since the last wait; the processor has none.
        self._used: set[wp.Stream | None] = set()
        self._lock = threading.Lock()

    def start(self, stream: wp.Stream | None) -> None:
        start_each(self._steps, stream)

    def replay(self) -> None:
        self()

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
        return stream_of(self._device.alias, address)


class GraphExchange(Exchange):
    """An exchange through page-locked memory; the graph of a recording includes its copies."""

    def __init__(
        self, backend: Backend, device: wp.Device, graphs: GraphCache, inputs: tuple[wp.array, int],
        results: tuple[wp.array, int],
    ) -> None:  # fmt: skip
        here = dict(device="cpu", pinned=device.is_cuda)
        given, taken = (wp.zeros(max(count, 1), dtype=array.dtype, **here) for array, count in (inputs, results))
        super().__init__(backend, inputs[0], given.numpy()[: inputs[1]], results[0], taken.numpy())
        self._device, self._graphs = device, graphs
        self._to_device = [Copy(inputs[0], given, inputs[1])] if inputs[1] else []
        self._to_host = Copy(taken, results[0], results[1])
        # True if the last start copies the results.
        self._takes = False

    def start(self, recording: Recording, *, between: Callable[[], None] | None = None) -> None:
        self._takes = False
        if between is not None or not isinstance(recording, WarpRecording):
            super().start(recording, between=between)
            return
        self._busy = self._takes = True
        if recording.exchanged is None:
            steps = [*self._to_device, recording, self._to_host]
            recording.exchanged = WarpRecording(self._device, self._graphs, steps)
        recording.exchanged()

    def explain(self, recording: Recording) -> str:
        return (getattr(recording, "exchanged", None) or recording).explain()

    def finish(self) -> np.ndarray:
        if not self._takes:
            return super().finish()
        if self._device.is_cuda:
            wp.synchronize_stream(self._device.stream)
        self._busy = False
        return self._taken.copy()
