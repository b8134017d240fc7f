"""Recordings: launches with the same arguments each time, each a kernel object of its own."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pyopencl as cl

from gpusense._util.checks import show
from gpusense.backends.opencl.memory import driver_errors


def is_unordered(queue: cl.CommandQueue) -> bool:
    """Whether a queue's commands may be done in another order than theirs."""
    return bool(queue.properties & cl.command_queue_properties.OUT_OF_ORDER_EXEC_MODE_ENABLE)


@dataclass(frozen=True)
class BoundLaunch:
    """A kernel whose arguments are set, its size and group, and its arguments, whose memory it keeps alive."""

    kernel: cl.Kernel
    size: tuple[int, ...]
    group: tuple[int, ...]
    arguments: tuple[Any, ...]


class Repeated:
    """See Recording; a stream is a queue of the same context."""

    def __init__(self, queue: cl.CommandQueue, launches: list[BoundLaunch], count: Callable[[int], None]) -> None:
        self._queue, self._launches, self._count = queue, launches, count
        # Queues of others on which they were started since the last wait.
        self._used: list[cl.CommandQueue] = []
        self._lock = threading.Lock()

    def __call__(self, stream: Any = None) -> None:
        """See Recording.__call__."""
        queue = self._queue if stream is None else self._checked(stream)
        # Two threads' launches must not be mixed.
        with self._lock, driver_errors():
            if stream is not None and queue not in self._used:
                self._used.append(queue)
            for launch in self._launches:
                cl.enqueue_nd_range_kernel(queue, launch.kernel, launch.size, launch.group)
            # Without this a driver may wait for more before it begins.
            queue.flush()
        self._count(len(self._launches))

    def __del__(self) -> None:
        # Memory that is shared with the host must not go while a queue works on it.
        if self._used:
            self.wait()

    def wait(self) -> None:
        """See Recording.wait."""
        with self._lock:
            used, self._used = [self._queue, *self._used], []
        with driver_errors():
            for queue in used:
                queue.finish()

    def _checked(self, stream: Any) -> cl.CommandQueue:
        same = isinstance(stream, cl.CommandQueue) and (stream.context, stream.device) == (
            self._queue.context,
            self._queue.device,
        )
        if not same:
            raise TypeError(f"stream: must be a queue of the model's context and device, got {show(stream)}")
        if is_unordered(stream):
            raise ValueError("stream: must be a queue that does commands in their order, got one that does not")
        return stream
