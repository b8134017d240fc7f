"""Run one call at a time in a process; watch, end and replace it.

Each process has a separate ``concurrent.futures.ProcessPoolExecutor``, so that its end fails only its call. All
executors run their jobs in such processes; with Dask they are children of the Dask workers.
"""

from __future__ import annotations

import contextlib
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
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor, wait
from multiprocessing.context import SpawnContext, SpawnProcess
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
    trace: str  # traceback of the error, for a log
    seconds: float  # time of the job [s]
    cpu_seconds: float  # processor time of the worker's process during the job [s]
    worker: str  # host and process of the worker
    device: str  # selection string of the device


# A worker runs one job at a time, since device and store serve only one.
_LOCK = threading.Lock()
# Stores by root, device and sweep, since files may change between sweeps.
_STORES: dict[tuple[str, str, str], Store] = {}
_SENT: dict[str, Any] = {}


def receive(sent: Mapping[str, Any]) -> None:
    """Keep the sent maps and logs for all jobs of this process."""
    with _LOCK:
        _SENT.update(sent)
        _STORES.clear()


def work(job: Job, root: str, device: str, sweep: str = "") -> Outcome:
    """Run a job in this process, on ``device`` unless the worker has one; errors are part of the result."""
    chosen = os.environ.get(DEVICE) or device
    with _LOCK:
        begin, begin_cpu = time.perf_counter(), time.process_time()
        key = (root, chosen, sweep)
        if key not in _STORES:
            _STORES.clear()
            _STORES[key] = Store(root, chosen)
            _STORES[key].receive(_SENT)
        values: dict[str, Any] = {}
        error = trace = ""
        try:
            found = task_of(job)(job, _STORES[key])
            # Python's numbers in place of NumPy's.
            values = {name: value.item() if hasattr(value, "item") else value for name, value in found.items()}
        except KeyboardInterrupt:
            # In this process the interrupt is the user's, and ends the sweep.
            raise
        except BaseException as problem:
            # SystemExit is also an error of the job, and does not end the worker.
            error, trace = error_text(problem), traceback.format_exc()
        seconds, cpu = time.perf_counter() - begin, time.process_time() - begin_cpu
    return Outcome(values, error, trace, seconds, cpu, f"{platform.node()}:{os.getpid()}", chosen)


def error_text(error: BaseException) -> str:
    """Format an error for a row, on one line."""
    try:
        text = f"{type(error).__name__}: {error}"
    except Exception:
        text = f"{type(error).__name__} without a text"
    return " ".join(text.split())[:_LONGEST]


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


class _Spawn(SpawnContext):
    """Start processes anew, since drivers do not survive a fork, and keep the last one, which knows its exit code."""

    last: SpawnProcess | None = None

    def Process(self, *args: Any, **kwargs: Any) -> SpawnProcess:  # type: ignore[override]
        self.last = SpawnProcess(*args, **kwargs)
        return self.last


class Worker:
    """A process that starts on first use and after its end, with sent maps and logs; it may choose no ``device``."""

    def __init__(self, device: str, sent: Mapping[str, Any] | None = None) -> None:
        self._device, self._sent, self._closed = device, sent or {}, False
        self._pool: ProcessPoolExecutor | None = None
        self._context = _Spawn()
        self._calls = threading.Lock()

    @property
    def processes(self) -> tuple[int, ...]:
        """Identifier of the process, if it runs."""
        process = self._context.last
        return () if process is None or process.pid is None or process.exitcode is not None else (process.pid,)

    def call(self, payload: bytes, seconds: float | None = None, wanted: Callable[[], bool] = lambda: True) -> bytes:
        """Run a pickled call of at most ``seconds`` in the process, and return the pickle of its answer.

        The process is ended once ``wanted()`` is false. Raises BrokenExecutor if processes end before they take a call,
        JobTimeout, and WorkerDied.
        """
        with self._calls:
            pool, process = self._started()
            end = None if seconds is None else time.monotonic() + seconds
            try:
                answer = pool.submit(_answer, payload)
            except BrokenExecutor:
                raise death(self._ended()) from None
            while not answer.done():
                wait([answer], _LOOK if end is None else min(_LOOK, max(end - time.monotonic(), 0)))
                if process.exitcode is not None:
                    # Child processes of the call may hold its pipes open and hide its end from the pool.
                    self._ended()
                    wait([answer], _GRACE)
                    break
                if not answer.done() and (self._closed or not wanted()):
                    self._ended()
                    raise WorkerDied("as nothing waits for its job any more")
                if not answer.done() and end is not None and time.monotonic() >= end:
                    self._ended()
                    raise JobTimeout(f"after the limit of {seconds:g} s")
            if answer.done() and answer.exception() is None:
                return answer.result()
            raise death(self._ended())

    def _started(self) -> tuple[ProcessPoolExecutor, SpawnProcess]:
        """Start the process if necessary, wait for its answer, and return its pool and it."""
        for _ in range(_STARTS):
            if self._closed:
                raise BrokenExecutor("worker: must not be used after its executor has ended")
            try:
                if self._pool is None:
                    self._pool = ProcessPoolExecutor(1, self._context, _begin, (self._device, self._sent))
                with _single_threads():
                    answer = self._pool.submit(os.getpid)
                answer.result()
            except BrokenExecutor:
                ended = death(self._ended())
            except OSError as error:
                raise BrokenExecutor(f"worker: must start, got {error}") from error
            else:
                assert self._context.last is not None
                return self._pool, self._context.last
        rule = "worker: must start (a script needs the guard if __name__ == '__main__')"
        raise BrokenExecutor(f"{rule}, got {_STARTS} that ended {ended.how}")

    def _ended(self) -> int | None:
        """End the process and everything that it has started, and return its exit code."""
        process, pool, self._pool = self._context.last, self._pool, None
        self.kill()
        if pool is not None:
            pool.shutdown(wait=False, cancel_futures=True)
        end = time.monotonic() + _GRACE
        # The pool's thread may fetch the exit code first and store it later.
        while process is not None and process.exitcode is None and time.monotonic() < end:
            time.sleep(0.002)
        if self._closed:
            raise BrokenExecutor("worker: must not be used after its executor has ended")
        return None if process is None else process.exitcode

    def kill(self) -> None:
        """End the process at once, with everything that it has started."""
        process = self._context.last
        if process is None or process.pid is None:
            return
        with contextlib.suppress(OSError, ValueError):
            if sys.platform != "win32":
                os.killpg(process.pid, signal.SIGKILL)
            process.kill()

    def close(self) -> None:
        """End the process, also during a call, and start no other one."""
        self._closed, pool = True, self._pool
        self.kill()
        if pool is not None:
            pool.shutdown(cancel_futures=True)


def result_of(answer: bytes) -> Any:
    """Return the result of a call, or raise its error."""
    succeeded, value = pickle.loads(answer)
    if succeeded:
        return value
    raise value


def deafen() -> None:
    """Block Ctrl-C in this thread, and so in the processes that it starts, until they ignore it."""
    if sys.platform != "win32":
        from multiprocessing import resource_tracker

        # A later start would unblock the signal.
        resource_tracker.ensure_running()
        signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])


@contextlib.contextmanager
def _single_threads() -> Iterator[None]:
    """Give processes that start one thread for linear algebra, unless the environment says otherwise."""
    with _STARTING:
        # Workers of Dask are daemons, which may not start processes by default.
        multiprocessing.current_process().daemon = False
        added = {name: value for name, value in _SINGLE.items() if name not in os.environ}
        os.environ.update(added)
        try:
            yield
        finally:
            for name in added:
                os.environ.pop(name, None)


# ---- in the worker's process


def _begin(device: str, sent: Mapping[str, Any]) -> None:
    """Make the process end with its parent, but not by the parent's Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if sys.platform != "win32":
        # A new process group: processes that a job has started end with the worker.
        with contextlib.suppress(OSError):
            os.setsid()
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])
        with contextlib.suppress(OSError), open("/proc/self/oom_score_adj", "w") as file:
            file.write(_EXPENDABLE)
    parent = multiprocessing.parent_process()
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    if sys.platform == "linux" and parent is not None:
        import fcntl

        # The kernel ends the process even in a job that never lets another thread run.
        with contextlib.suppress(OSError):
            fcntl.fcntl(parent.sentinel, fcntl.F_SETOWN, os.getpid())
            fcntl.fcntl(parent.sentinel, fcntl.F_SETSIG, signal.SIGKILL)
            fcntl.fcntl(parent.sentinel, fcntl.F_SETFL, fcntl.fcntl(parent.sentinel, fcntl.F_GETFL) | os.O_ASYNC)
    if device:
        os.environ[DEVICE] = device
    receive(sent)


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
