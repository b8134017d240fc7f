"""Recordings: launches whose arguments stay set, each with a kernel object for itself."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pyopencl as cl

from gpusense._util.checks import show
from gpusense._util.interrupts import undisturbed
from gpusense.backends.base import Recording, pluralize
from gpusense.backends.opencl.arrays import check_in_order
from gpusense.backends.opencl.memory import driver_errors, raise_clearly


@dataclass(frozen=True)
class BoundLaunch:
    """A kernel with its arguments set, its size and group; keeps the arguments' memory alive."""

    kernel: cl.Kernel
    size: tuple[int, ...]
    group: tuple[int, ...]
    arguments: tuple[Any, ...]


class OpenCLRecording(Recording):
    """Launches that are enqueued together; a stream is a queue of the same context."""

    def __init__(self, queue: cl.CommandQueue, launches: list[BoundLaunch], count: Callable[[int], None]) -> None:
        self._queue, self._launches, self._count = queue, launches, count
        self._lock = threading.Lock()
        # Queues of users on which they were started since the last wait.
        self._used: list[cl.CommandQueue] = []

    def __call__(self, stream: Any = None) -> None:
        queue = self._queue if stream is None else self._checked(stream)
        # Before and after; see ``OpenCLBackend.enqueue``.
        self._count(len(self._launches))
        # The launches of two threads must not interleave.
        with self._lock:
            if stream is not None and queue not in self._used:
                self._used.append(queue)
            try:
                for launch in self._launches:
                    cl.enqueue_nd_range_kernel(queue, launch.kernel, launch.size, launch.group)
                # Flush: a driver may otherwise wait for further commands before it begins.
                queue.flush()
            except cl.Error as error:
                raise_clearly(error)
        self._count(len(self._launches))

    def __del__(self, run: Callable[[Callable[[], object]], None] = undisturbed) -> None:
        # As a default, the function is there when the interpreter ends and has emptied its modules.
        # Memory that is shared with the host must not go while a queue works on it.
        # An interrupt may come before there is one.
        if getattr(self, "_used", None):
            run(self._wait_for_all)

    def wait(self, *, elsewhere: bool = False) -> None:
        self._wait_for_all(elsewhere=elsewhere)
        with self._lock:
            self._used.clear()

    def _wait_for_all(self, *, elsewhere: bool = False) -> None:
        """Wait for the device's queue and for users' queues; repeated after an interrupt, it waits for all again."""
        with self._lock:
            used = [*self._used] if elsewhere else [self._queue, *self._used]
        with driver_errors():
            for queue in used:
                queue.finish()

    def explain(self) -> str:
        return f"{pluralize(len(self._launches), 'launch')} one by one, their arguments stay set: OpenCL has no graphs"

    def _checked(self, stream: Any) -> cl.CommandQueue:
        """Return a user's queue for the stream of a call."""
        same = isinstance(stream, cl.CommandQueue) and (stream.context, stream.device) == (
            self._queue.context,
            self._queue.device,
        )
        if not same:
            raise TypeError(f"stream: must be a queue of the model's context and device, got {show(stream)}")
        check_in_order(stream, "stream")
        return stream
