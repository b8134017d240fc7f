"""Supervise a worker's process: start it, watch it during a call, end and replace it.

All executors run their jobs in such processes; with Dask these belong to the Dask workers. A process runs one call at a
time, so that its end is charged to this call alone.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import pickle
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor
from multiprocessing import resource_tracker
from multiprocessing.connection import wait
from typing import Any, NamedTuple

from gpusense._util import checks
from gpusense.sweeps.child import BEGUN, READY, serve
from gpusense.sweeps.deaths import JobTimeout, WorkerDied, death
from gpusense.sweeps.memory import memory_of, shortages, size_text

# Processes in a row that may end before they take a call.
_STARTS = 3
# Seconds between two checks of a process that runs a call, without and with a memory limit.
_LOOK, _LOOK_MEMORY = 0.25, 0.05
# Threads of the libraries of linear algebra: jobs run side by side, and threads that wait for small matrices take turns
# at the processors of other jobs. Dask starts its workers so.
_SINGLE = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
_STARTING = threading.Lock()
# Seconds for a process to end by itself, and after it has closed its link; seconds between two checks.
_GRACE, _CLOSING, _SOON = 10.0, 2.0, 0.005


class Limits(NamedTuple):
    """Limits of a job.

    Attributes:
        seconds: Longest time; None for no limit.
        memory: Most resident memory of its process [bytes]; None for no limit.
    """

    seconds: float | None = None
    memory: int | None = None


def limits_of(job_timeout: float | None, memory_limit: int | None) -> Limits:
    """Return the limits from an executor's arguments.

    Raises:
        TypeError, ValueError: an argument breaks its rule, or the memory of processes is unknown on this system.
    """
    seconds = None if job_timeout is None else checks.real("job_timeout", job_timeout, above=0)
    memory = None if memory_limit is None else checks.integer("memory_limit", memory_limit, low=1)
    if memory is not None and not memory_of(os.getpid()):
        raise ValueError(f"memory_limit: must be None without psutil on this system, got {memory}")
    return Limits(seconds, memory)


class Supervised:
    """One process, which is started on first use and again after its end.

    Args:
        device: Selection string of its device; empty leaves that of the environment.
        prepare: Payloads of calls that each new process runs first.
    """

    def __init__(self, device: str, prepare: Callable[[], list[bytes]] = list) -> None:
        self._device, self._prepare = device, prepare
        self._process: Any = None
        self._link: Any = None
        self._lock = threading.Lock()
        self._closed = False

    @property
    def processes(self) -> tuple[int, ...]:
        """Identifier of the process, if it runs."""
        process = self._process
        return () if process is None or process.pid is None or process.exitcode is not None else (process.pid,)

    def call(self, payload: bytes, limits: Limits, wanted: Callable[[], bool] = lambda: True) -> bytes:
        """Run a call in the process, and return the pickle of its answer.

        Args:
            payload: The call.
            limits: Its limits.
            wanted: Tells whether anything still waits for the answer; otherwise the process is ended.

        Raises:
            BrokenExecutor: processes end before they take a call, or the executor was ended.
            JobTimeout: the call took too long; the process was ended.
            WorkerDied: the process ended in the call.
        """
        for _ in range(_STARTS):
            if self._begun(payload):
                return self._watched(limits, wanted)
            ended = self._buried()
        rule = "worker: must start (a script needs the guard if __name__ == '__main__')"
        raise BrokenExecutor(f"{rule}, got {_STARTS} that ended {ended.how}")

    def _begun(self, payload: bytes) -> bool:
        """Hand a call to the process, which is started if necessary; return whether the process has begun the call."""
        if self._process is not None and not self._alive():
            self._buried()
        try:
            if self._process is None:
                self._start()
                if self._received() != READY:
                    return False
                for first in self._prepare():
                    self._link.send_bytes(first)
                    if self._received() != BEGUN or self._received() is None:
                        return False
            self._link.send_bytes(payload)
        except OSError:
            self._check_open()
            return False
        return self._received() == BEGUN

    def _start(self) -> None:
        # Drivers do not survive a fork.
        context = multiprocessing.get_context("spawn")
        here, there = context.Pipe()
        process = context.Process(target=serve, args=(there, self._device), daemon=True, name="gpusense-sweep")
        with self._lock, _parent_of_processes():
            self._check_open()
            try:
                with _single_threads():
                    process.start()
            except OSError as error:
                raise BrokenExecutor(f"worker: must start, got {error}") from error
            self._process, self._link = process, here
        there.close()

    def _check_open(self) -> None:
        if self._closed:
            raise BrokenExecutor("worker: must not be used after its executor has ended")

    def _alive(self) -> bool:
        return not wait([self._process.sentinel], 0) and self._process.exitcode is None

    def _received(self) -> bytes | None:
        """Return the next message of the process; None after its end."""
        while True:
            try:
                if wait([self._link, self._process.sentinel], _LOOK) or not self._alive():
                    # The link may still hold messages from before the process's end.
                    return bytes(self._link.recv_bytes()) if self._link.poll() else None
            except (EOFError, OSError):
                return None

    def _watched(self, limits: Limits, wanted: Callable[[], bool]) -> bytes:
        """Wait for the answer of a call, within its limits."""
        most, begin, short = 0, time.monotonic(), shortages()
        process, link = self._process, self._link
        look = _LOOK if limits.memory is None else _LOOK_MEMORY
        while True:
            left = look if limits.seconds is None else limits.seconds - (time.monotonic() - begin)
            most = max(most, memory_of(process.pid))
            if limits.memory is not None and most > limits.memory:
                self._buried(forced=True)
                raise WorkerDied(f"beyond the memory limit of {size_text(limits.memory)}", most)
            ready = wait([link, process.sentinel], max(min(look, left), 0))
            if ready or not self._alive():
                message = self._received()
                if message is not None:
                    return message
                raise self._buried(most, short)
            if not wanted():
                self._buried(forced=True)
                raise WorkerDied("as nothing waits for its job any more", most)
            if left <= 0:
                self._buried(forced=True)
                raise JobTimeout(f"after the limit of {limits.seconds:g} s", most)

    def _buried(self, memory: int = 0, short: int = 0, *, forced: bool = False) -> WorkerDied:
        """End the process and everything that it has started, and return the exception for its end."""
        process = self._process
        if process is None:
            return WorkerDied("before it started")
        if not forced:
            # Its link closes slightly before the process ends.
            _await_end(process, _CLOSING)
        self.kill()
        _await_end(process, _GRACE)
        code = process.exitcode
        with self._lock:
            self._link.close()
            self._process = self._link = None
        self._check_open()
        return death(code, memory, shortages() > short)

    def kill(self) -> None:
        """End the process at once, with everything that it has started."""
        process = self._process
        if process is None or process.pid is None:
            return
        if sys.platform != "win32":
            # End its group while no other process can take its number.
            with contextlib.suppress(OSError):
                os.killpg(process.pid, signal.SIGKILL)
        with contextlib.suppress(OSError):
            process.kill()

    def close(self, wait: bool = True) -> None:
        """End the process after its call or, without waiting, also during a call."""
        with self._lock:
            self._closed = True
            process, link = self._process, self._link
        if process is None:
            return
        if wait:
            link.close()
            process.join(_GRACE)
        if process.exitcode is None:
            self.kill()
            process.join(_GRACE)


def _await_end(process: Any, seconds: float) -> None:
    """Wait until a process has ended, without reaping it where the system allows that."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if sys.platform == "linux":
            try:
                if os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is not None:
                    return
            except ChildProcessError:
                # It has already been reaped.
                return
        elif process.exitcode is not None:
            return
        time.sleep(_SOON)


def pickled(function: Callable[..., Any], args: Any, kwargs: Any) -> bytes:
    """Return the payload of a call to a module's function."""
    from multiprocessing.reduction import ForkingPickler

    return bytes(ForkingPickler.dumps((function, args, kwargs)))


def result_of(answer: bytes) -> Any:
    """Return the result of a call, or raise its error."""
    succeeded, value = pickle.loads(answer)
    if succeeded:
        return value
    raise value


@contextlib.contextmanager
def _single_threads() -> Iterator[None]:
    """Give processes that start one thread for linear algebra, unless the environment says otherwise."""
    with _STARTING:
        added = {name: value for name, value in _SINGLE.items() if name not in os.environ}
        os.environ.update(added)
        try:
            yield
        finally:
            for name in added:
                os.environ.pop(name, None)


@contextlib.contextmanager
def _parent_of_processes() -> Iterator[None]:
    """Allow this process to start child processes that do not receive Ctrl-C while they start."""
    # Workers of Dask are daemons, which may not start processes by default.
    multiprocessing.current_process().daemon = False
    if sys.platform == "win32":
        yield
        return
    # Started later, it would receive Ctrl-C.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
