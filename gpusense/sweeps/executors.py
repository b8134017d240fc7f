"""Executors with the standard library's interface: in this process, or with workers that a thread each supervises.

``submit(function, *arguments)`` returns a ``concurrent.futures.Future``. Each has ``slots``, the number of jobs that it
runs at once. The death of a worker raises :class:`WorkerDied` in the future of its job, and the executor replaces the
worker.
"""

from __future__ import annotations

import math
import pickle
import queue
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from types import TracebackType
from typing import Any

from gpusense._util import checks
from gpusense.sweeps.process import Worker, result_of


class SerialExecutor(Executor):
    """Runs each job in this process when it is submitted; a job that ends the process ends the sweep.

    Example:
        >>> import gpusense as gs
        >>> gs.sweep.SerialExecutor().submit(max, 1, 2).result()
        2
    """

    slots = 1

    def __repr__(self) -> str:
        return "SerialExecutor()"

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Run a function, and return its finished future."""
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


class SupervisedExecutor(Executor):
    """Executor with a thread for each running call; it ends calls if its ``with`` block ends by an exception."""

    def __init__(self, threads: int, job_timeout: float | None) -> None:
        self._seconds = math.inf if job_timeout is None else checks.real("job_timeout", job_timeout, above=0)
        self._threads = ThreadPoolExecutor(threads, "gpusense-sweep")

    def call(self, function: Callable[..., Any], args: Any, kwargs: Any) -> bytes:
        """Run a function in a worker, and return the pickle of its success and of its result or error."""
        raise NotImplementedError

    def end(self) -> None:
        """End the workers at once, together with their jobs."""
        raise NotImplementedError

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Queue a function for the next free worker; if that ends, the future raises :class:`WorkerDied`."""
        return self._threads.submit(lambda: result_of(self.call(fn, args, kwargs)))

    def terminate(self) -> None:
        """End the workers at once, together with their jobs."""
        self._threads.shutdown(wait=False, cancel_futures=True)
        self.end()

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the workers after their running jobs."""
        self._threads.shutdown(wait=wait, cancel_futures=cancel_futures)
        if wait:
            self.end()
        else:
            threading.Thread(target=self.shutdown, name="gpusense-sweep-end").start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool | None:
        if kind is not None:
            self.terminate()
        return super().__exit__(kind, error, trace)


class ProcessExecutor(SupervisedExecutor):
    """Run jobs in a spawned process for each device.

    A process runs one job at a time. If it ends during its job, it raises :class:`WorkerDied` in the job's future and
    is replaced. If the ``with`` block ends by an exception, such as Ctrl-C, the processes are ended at once.

    Args:
        devices: A selection string for each process; or the number of processes, all on the sweep's device.
        job_timeout: Longest time of a job [s]; its process is ended and replaced, and its future raises
            :class:`JobTimeout`. None for no limit.

    Attributes:
        slots: Number of processes.

    Raises:
        TypeError, ValueError: ``devices`` has no process or holds no strings, or the limit breaks its rule.

    Example:
        >>> import gpusense as gs
        >>> gs.sweep.ProcessExecutor(["opencl:0:0", "warp:cuda:0"])
        ProcessExecutor(['opencl:0:0', 'warp:cuda:0'])
    """

    def __init__(self, devices: int | Sequence[str] = 1, *, job_timeout: float | None = None) -> None:
        self._names = device_names(devices)
        self.slots = len(self._names)
        super().__init__(self.slots, job_timeout)
        self._all = [Worker(name) for name in self._names]
        self._free: queue.SimpleQueue[Worker] = queue.SimpleQueue()
        for one in self._all:
            self._free.put(one)

    def __repr__(self) -> str:
        return f"ProcessExecutor({self._names if any(self._names) else self.slots})"

    @property
    def processes(self) -> tuple[int, ...]:
        """Identifiers of the running processes."""
        return tuple(number for one in self._all for number in one.processes)

    def call(self, function: Callable[..., Any], args: Any, kwargs: Any) -> bytes:
        """Run a function of a module in a free process."""
        payload, worker = pickle.dumps((function, args, kwargs)), self._free.get()
        try:
            return worker.call(payload, self._seconds)
        finally:
            self._free.put(worker)

    def end(self) -> None:
        """End the processes at once, together with their jobs."""
        for one in self._all:
            one.close()


def device_names(devices: int | Sequence[str]) -> list[str]:
    """Return the selection string of each worker; empty strings for a number of workers."""
    if isinstance(devices, (str, bool)) or not isinstance(devices, (Sequence, int)):
        raise TypeError(f"devices: must be a number or selection strings, got {checks.show(devices)}")
    names = [""] * devices if isinstance(devices, int) else list(devices)
    if not names or not all(isinstance(name, str) for name in names):
        raise ValueError(f"devices: must be at least one worker, got {checks.show(devices)}")
    return names
