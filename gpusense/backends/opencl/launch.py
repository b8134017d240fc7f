"""Launch OpenCL kernels, bind their arguments by the signature table, and record launches."""

from __future__ import annotations

import contextlib
import importlib
import logging
import sqlite3
import struct
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import pyopencl as cl

from gpusense._util.checks import show
from gpusense._util.interrupts import undisturbed
from gpusense.backends.base import Recording, pluralize
from gpusense.backends.opencl.memory import check_in_order, driver_errors, raise_clearly
from gpusense.interface import structs
from gpusense.interface.signatures import Argument, Kernel, lanes_of, team_of

# Longest time for which the end of a launch is watched [s].
_WATCHED = 1e-4


def watch(event: cl.Event) -> None:
    """Return once a launch has ended, or after a short while, without sleeping.

    PoCL's worker ends a short launch earlier than a thread falls asleep and wakes up, which takes 30 to 40 us.
    """
    end = time.perf_counter() + _WATCHED
    while event.command_execution_status > cl.command_execution_status.COMPLETE and time.perf_counter() < end:
        pass


class Enqueuer(Protocol):
    """A queue of launches."""

    def enqueue(self, kernel: cl.Kernel, size: tuple[int, ...], group: tuple[int, ...]) -> None:
        """Enqueue a launch of a kernel whose arguments are set."""


class Launch:
    """A kernel that binds arguments by the signature table and enqueues its launch."""

    def __init__(
        self,
        backend: Enqueuer,
        kernel: cl.Kernel,
        row: Kernel,
        flags: frozenset[str],
        limit: int,
        first: Callable[[], None] | None = None,
        multiple: int = 1,
    ) -> None:
        self._backend, self._kernel = backend, kernel
        # Most work-items of a group of the kernel on the device.
        self.limit = limit
        # Function that is called once, before the kernel's first launch.
        self._first = first
        self._lanes, self._group = (1, row.group)
        if "IN_LANES" in flags:
            self._lanes, self._group = (lanes_of(flags) if row.in_lanes else 1), row.lanes_group
        elif "IN_TEAMS" in flags:
            self._group = team_of(row, flags)
        if "IN_TEAMS" not in flags:
            self._group = min(-(-self._group // multiple) * multiple, limit)
        self._lock = threading.Lock()
        real = np.dtype(np.float64 if "FLOAT64" in flags else np.float32)
        # With its types set, pyopencl sets all arguments in 1 us; otherwise a single number takes 6 us.
        self._types = [_set_as(argument, real) for argument in row.arguments]
        # Places of structs, and functions that pack them into the bytes that the device reads.
        self._packers = [
            (place, struct.Struct(structs.layout(argument.type, real)).pack)
            for place, argument in enumerate(row.arguments)
            if argument.is_struct
        ]
        self._last_structs: list[tuple[Any, bytes]] = [(None, b"")] * len(self._packers)
        self._last_size: tuple[Any, Any] = (None, None)
        with without_caches():
            kernel.set_arg_types(self._types)

    def __call__(self, size: tuple[int, ...], *arguments: Any) -> None:
        """See Launcher.__call__."""
        if self._first is not None:
            self._before_first()
        # Arguments belong to the kernel object, so two threads must not interleave.
        with self._lock:
            packed = list(arguments)
            for number, (place, pack) in enumerate(self._packers):
                # Calls mostly repeat the last struct.
                if packed[place] is not self._last_structs[number][0]:
                    self._last_structs[number] = packed[place], pack(*packed[place])
                packed[place] = self._last_structs[number][1]
            if size != self._last_size[0]:
                self._last_size = size, self._sizes(size)
            try:
                self._kernel.set_args(*packed)
                self._backend.enqueue(self._kernel, *self._last_size[1])
            except cl.Error as error:
                raise_clearly(error)

    def bind(self, size: tuple[int, ...], arguments: tuple[Any, ...]) -> BoundLaunch:
        """Set the arguments of a new kernel object, and start nothing."""
        if self._first is not None:
            self._before_first()
        kernel = new_kernel(self._kernel.program, self._kernel.function_name)
        with without_caches():
            kernel.set_arg_types(self._types)
        packed = list(arguments)
        for place, pack in self._packers:
            packed[place] = pack(*packed[place])
        kernel.set_args(*packed)
        return BoundLaunch(kernel, *self._sizes(size), arguments)

    def _before_first(self) -> None:
        """Call the function for the first launch."""
        if self._first is not None:
            self._first()
            self._first = None

    def _sizes(self, size: tuple[int, ...]) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Return the size in whole groups, and the group."""
        group = (self._group, *(1 for _ in size[1:]))
        return (-(-size[0] // (self._lanes * group[0])) * group[0], *size[1:]), group


def _set_as(argument: Argument, real: np.dtype) -> Any:
    """Return the type with which pyopencl sets an argument; None for buffers."""
    if argument.is_struct:
        return np.dtype(("V", struct.calcsize(structs.layout(argument.type, real))))
    return argument.dtype(real).type if argument.shape is None else None


# ---- recordings: launches whose arguments stay set, each with a kernel object for itself


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


# ---- switch pyopencl's caches off: a read-only folder or a damaged file would end the run


# True if pyopencl's caches are off; once it is imported it has no other switch.
_SWITCH = "_PYOPENCL_NO_CACHE"
_lock = threading.RLock()


def _open_database() -> None:
    """Import the module that opens the database; where that fails the caches are off for the whole process."""
    if getattr(cl, _SWITCH, True):
        return
    # An object whose construction failed reports that again when it is collected.
    hook, sys.unraisablehook = sys.unraisablehook, lambda *_: None
    try:
        importlib.import_module("pyopencl.invoker")
    except (ImportError, OSError, sqlite3.Error) as error:
        setattr(cl, _SWITCH, True)
        # Programs of gpusense are never kept there.
        logging.getLogger("gpusense").info("gpusense: pyopencl's cache cannot be used and is left out: %s", error)
        error.__traceback__ = None
    finally:
        sys.unraisablehook = hook


_open_database()


def new_kernel(program: Any, name: str) -> cl.Kernel:
    """Return a new kernel object of a program."""
    with without_caches():
        return cl.Kernel(program, name)


@contextlib.contextmanager
def without_caches() -> Iterator[None]:
    """Switch pyopencl's caches off, and restore them on leaving."""
    with _lock:
        before = getattr(cl, _SWITCH, None)
        if before is None:
            yield
            return
        setattr(cl, _SWITCH, True)
        try:
            yield
        finally:
            setattr(cl, _SWITCH, before)
