"""Run one call at a time in a process; watch, end and replace it.

All executors run their jobs in such processes; with Dask they are children of the Dask workers.
"""

from __future__ import annotations

import contextlib
import functools
import math
import multiprocessing
import os
import pickle
import platform
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import BrokenExecutor
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from typing import Any, NamedTuple

from gpusense.sweeps.job import Job, Store
from gpusense.sweeps.tasks import task_of

# Environment variable with the selection string of a worker's device.
DEVICE = "GPUSENSE_SWEEP_DEVICE"
# Longest text of an error.
_LONGEST = 400


class Outcome(NamedTuple):
    """The result of a job."""

    values: dict[str, Any]  # columns of its row by name; empty after a failure
    error: str  # the error in one line; empty after success
    seconds: float = 0.0  # time of the job [s]
    cpu_seconds: float = 0.0  # processor time of the worker's process during the job [s]
    worker: str = ""  # host and process of the worker
    device: str = ""  # selection string of the device


# A worker runs one job at a time, since device and store serve only one.
_LOCK = threading.Lock()
# Maps, and files of logs, that this process was sent.
SENT: dict[str, Any] = {}


@functools.lru_cache(maxsize=1)
def _store(root: str, device: str, sweep: str) -> Store:
    """Return the store of a sweep; another sweep reads its files again, since they may have changed."""
    return Store(root, device, SENT)


def work(job: Job, root: str, device: str, sweep: str = "") -> Outcome:
    """Run a job in this process, on ``device`` unless the worker has one; errors are part of the result."""
    chosen = os.environ.get(DEVICE) or device
    with _LOCK:
        begin, begin_cpu = time.perf_counter(), time.process_time()
        values: dict[str, Any] = {}
        error = ""
        try:
            found = task_of(job)(job, _store(root, chosen, sweep))
            # Python's numbers in place of NumPy's.
            values = {name: value.item() if hasattr(value, "item") else value for name, value in found.items()}
        except KeyboardInterrupt:
            # In this process the interrupt is the user's, and ends the sweep.
            raise
        except BaseException as problem:
            # SystemExit is also an error of the job, and does not end the worker.
            error = error_text(problem)
        seconds, cpu = time.perf_counter() - begin, time.process_time() - begin_cpu
    return Outcome(values, error, seconds, cpu, f"{platform.node()}:{os.getpid()}", chosen)


def error_text(error: BaseException) -> str:
    """Format an error for a row, on one line."""
    try:
        text = f"{type(error).__name__}: {error}"
    except Exception:
        text = f"{type(error).__name__} without a text"
    return " ".join(text.split())[:_LONGEST]


class WorkerDied(BrokenExecutor):
    """A worker ended while it ran a job.

    Args:
        how: Kind of the end, such as "by SIGSEGV" or "with exit code 3".
        outside: Whether the cause may lie outside the job: a signal of another process, or the loss of a machine.

    Example:
        >>> import gpusense as gs
        >>> print(gs.sweep.WorkerDied("by SIGSEGV"))
        the worker ended by SIGSEGV
    """

    def __init__(self, how: str = "for an unknown reason", outside: bool = False) -> None:
        super().__init__(how, outside)
        self.how, self.outside = how, outside

    def __str__(self) -> str:
        return f"the worker ended {self.how}"


class JobTimeout(WorkerDied):
    """A job ran for longer than its limit, and its worker was ended.

    Example:
        >>> import gpusense as gs
        >>> print(gs.sweep.JobTimeout("after the limit of 60 s"))
        the worker was ended after the limit of 60 s
    """

    def __str__(self) -> str:
        return f"the worker was ended {self.how}"


def death(code: int | None) -> WorkerDied:
    """Return the exception for a process that ended with an exit code."""
    if code is None:
        return WorkerDied(outside=True)
    if code >= 0:
        return WorkerDied(f"with exit code {code if code < 1 << 16 else hex(code)}")
    try:
        name = signal.Signals(-code).name
    except ValueError:
        name = f"signal {-code}"
    return WorkerDied(f"by {name}", outside=name == "SIGKILL")


# Processes start anew, since drivers do not survive a fork.
_SPAWN = multiprocessing.get_context("spawn")
# Most consecutive processes that end before taking a call.
_STARTS = 3
# Interval between checks of a process, and time for it to end after a kill [s].
_LOOK, _GRACE = 0.25, 10.0
# Threads of the libraries of linear algebra: jobs run side by side, and threads that wait for small matrices take turns
# at the processors of other jobs. Dask starts its workers so.
_SINGLE = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
_STARTING = threading.Lock()
# If memory is short, the system ends workers before their parent.
_EXPENDABLE = "500"


class Worker:
    """A process that starts on first use and after its end, with sent maps and logs; it may choose no ``device``."""

    def __init__(self, device: str, sent: Mapping[str, Any] | None = None) -> None:
        self._options = device, dict(sent or {})
        self._process: SpawnProcess | None = None
        self._pipe: Connection | None = None
        self._closed, self._calls = False, threading.Lock()

    @property
    def processes(self) -> tuple[int, ...]:
        """Identifier of the process, if it runs."""
        process = self._process
        return () if process is None or process.pid is None or process.exitcode is not None else (process.pid,)

    def call(self, payload: bytes, seconds: float = math.inf, wanted: Callable[[], bool] = lambda: True) -> bytes:
        """Run a pickled call of at most ``seconds`` in the process, and return the pickle of its answer.

        The process is ended once ``wanted()`` is false. Raises BrokenExecutor if processes end before they take a call,
        JobTimeout, and WorkerDied.
        """
        with self._calls:
            for start in range(1, _STARTS + 1):
                try:
                    # The end of a process between two calls costs no start of a job.
                    self._exchange(b"", math.inf, wanted)
                    break
                except WorkerDied as error:
                    if start == _STARTS:
                        rule = "worker: must start (a script needs the guard if __name__ == '__main__')"
                        raise BrokenExecutor(f"{rule}, got {start} that ended {error.how}") from None
            return self._exchange(payload, seconds, wanted)

    def _exchange(self, payload: bytes, seconds: float, wanted: Callable[[], bool]) -> bytes:
        """Start the process if necessary, send a call, and wait for its answer or its end."""
        process, pipe = self._started()
        end = time.monotonic() + seconds
        try:
            pipe.send_bytes(payload)
            while not pipe.poll(min(_LOOK, max(end - time.monotonic(), 0))):
                # Child processes of the call may hold its end of the pipe open.
                if process.exitcode is not None:
                    raise EOFError
                if self._closed or not wanted():
                    self._end(process)
                    raise WorkerDied("as nothing waits for its job any more")
                if time.monotonic() >= end:
                    self._end(process)
                    raise JobTimeout(f"after the limit of {seconds:g} s")
            return pipe.recv_bytes()
        except (EOFError, OSError):
            raise death(self._end(process)) from None

    def _started(self) -> tuple[SpawnProcess, Connection]:
        if self._closed:
            raise BrokenExecutor("worker: must not be used after its executor has ended")
        if self._process is None or self._pipe is None:
            try:
                self._pipe, other = _SPAWN.Pipe()
                self._process = _SPAWN.Process(target=_serve, args=(other, *self._options), daemon=True)
                with other, _starting():
                    self._process.start()
            except OSError as error:
                self._process = None
                raise BrokenExecutor(f"worker: must start, got {error}") from error
        return self._process, self._pipe

    def _end(self, process: SpawnProcess) -> int | None:
        """End the process and everything that it has started, and return its exit code."""
        self.kill()
        end = time.monotonic() + _GRACE
        while process.exitcode is None and time.monotonic() < end:
            time.sleep(0.002)
        self._process = None
        if self._closed:
            raise BrokenExecutor("worker: must not be used after its executor has ended")
        return process.exitcode

    def kill(self) -> None:
        """End the process at once, with everything that it has started."""
        process = self._process
        if process is not None and process.pid is not None:
            with contextlib.suppress(OSError, AttributeError):
                os.killpg(process.pid, signal.SIGKILL)
            with contextlib.suppress(OSError, ValueError):
                process.kill()

    def close(self) -> None:
        """End the process, also during a call, and start no other one."""
        self._closed, process = True, self._process
        self.kill()
        if process is not None and process.pid is not None:
            process.join(_GRACE)


def result_of(answer: bytes) -> Any:
    """Return the result of a call, or raise its error."""
    succeeded, value = pickle.loads(answer)
    if succeeded:
        return value
    raise value


@contextlib.contextmanager
def _starting() -> Iterator[None]:
    """Let processes start with one thread for linear algebra, unless the environment says otherwise, deaf to Ctrl-C."""
    with _STARTING:
        # Workers of Dask are daemons, which may not start processes by default.
        multiprocessing.current_process().daemon = False
        added = {name: value for name, value in _SINGLE.items() if name not in os.environ}
        os.environ.update(added)
        mask = None
        if sys.platform != "win32":
            from multiprocessing import resource_tracker

            # Its later start would unblock the signal.
            resource_tracker.ensure_running()
            mask = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
        try:
            yield
        finally:
            if mask is not None:
                signal.pthread_sigmask(signal.SIG_SETMASK, mask)
            for name in added:
                os.environ.pop(name, None)


# ---- in the worker's process


def _serve(pipe: Connection, device: str, sent: Mapping[str, Any]) -> None:
    """Answer calls until the parent ends, by any cause but its Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    process = multiprocessing.current_process()
    # Jobs may start processes.
    process.daemon = False
    if sys.platform != "win32":
        # A new process group: processes that a job has started end with the worker.
        with contextlib.suppress(OSError):
            os.setsid()
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])
        with contextlib.suppress(OSError), open("/proc/self/oom_score_adj", "w") as file:
            file.write(_EXPENDABLE)
    parent: Any = multiprocessing.parent_process()
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    if sys.platform == "linux":
        import fcntl

        # The kernel ends the process even in a job that never lets another thread run.
        with contextlib.suppress(OSError):
            fcntl.fcntl(parent.sentinel, fcntl.F_SETOWN, os.getpid())
            fcntl.fcntl(parent.sentinel, fcntl.F_SETSIG, signal.SIGKILL)
            fcntl.fcntl(parent.sentinel, fcntl.F_SETFL, fcntl.fcntl(parent.sentinel, fcntl.F_GETFL) | os.O_ASYNC)
    if device:
        os.environ[DEVICE] = device
    SENT.update(sent)
    with contextlib.suppress(EOFError, OSError):
        while True:
            payload = pipe.recv_bytes()
            pipe.send_bytes(_answer(payload) if payload else b"")


def _end_with(parent: Any) -> None:
    while parent.is_alive() and os.getppid() == parent.pid:
        parent.join(5.0)
    os._exit(1)


def _answer(payload: bytes) -> bytes:
    """Run a call, and return the pickle of its success and of its result or error."""
    try:
        function, args, kwargs = pickle.loads(payload)
        return pickle.dumps((True, function(*args, **kwargs)))
    except BaseException as error:
        # Any error belongs to the job: Ctrl-C is handled by the parent, and SystemExit must not end the process.
        with contextlib.suppress(Exception):
            error.add_note(f"in the worker:\n{''.join(traceback.format_exception(error))}")
            dumped = pickle.dumps((False, error))
            pickle.loads(dumped)
            return dumped
        return pickle.dumps((False, RuntimeError(error_text(error))))
