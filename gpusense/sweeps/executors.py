"""Executors of the standard library's shape: in this process, in processes, or on a Dask cluster.

``submit(function, *arguments)`` returns a ``concurrent.futures.Future``. Each has ``slots``, the jobs that it runs at
once. A worker that dies raises :class:`WorkerDied` in its future, and the executor replaces it.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import multiprocessing.connection
import os
import queue
import signal
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor
from typing import Any

from gpusense._util import checks
from gpusense.sweeps.worker import DEVICE


class WorkerDied(BrokenExecutor):
    """A worker ended while it ran a job."""


class SerialExecutor(Executor):
    """Runs each job in this process when it is submitted.

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


class ProcessExecutor(Executor):
    """Processes that are started by spawn, one for each device.

    Args:
        devices: Selection strings of the devices, one for each process; or the number of processes, which then use the
            sweep's device.

    Attributes:
        slots: Number of processes.

    Raises:
        TypeError, ValueError: no process, or no texts.

    Example:
        >>> import gpusense as gs
        >>> gs.sweep.ProcessExecutor(["opencl:0:0", "warp:cuda:0"])
        ProcessExecutor(['opencl:0:0', 'warp:cuda:0'])
    """

    def __init__(self, devices: int | Sequence[str] = 1) -> None:
        if isinstance(devices, str) or not isinstance(devices, (Sequence, int)):
            raise TypeError(f"devices: must be a number or selection strings, got {checks.show(devices)}")
        names = [""] * devices if isinstance(devices, int) else list(devices)
        if not names or not all(isinstance(name, str) for name in names):
            raise ValueError(f"devices: must be at least one process, got {checks.show(devices)}")
        self._names, self.slots = names, len(names)
        # A thread for each process hands it one job after the other.
        self._threads = ThreadPoolExecutor(self.slots, thread_name_prefix="gpusense-sweep")
        self._lanes: queue.SimpleQueue[_Lane] = queue.SimpleQueue()
        self._all = [_Lane(name) for name in names]
        for lane in self._all:
            self._lanes.put(lane)

    def __repr__(self) -> str:
        return f"ProcessExecutor({self._names if any(self._names) else self.slots})"

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Queue a function of a module for the next free process."""
        return self._threads.submit(self._run, fn, args, kwargs)

    def _run(self, fn: Callable[..., Any], args: Any, kwargs: Any) -> Any:
        lane = self._lanes.get()
        try:
            return lane.call(fn, args, kwargs)
        finally:
            self._lanes.put(lane)

    @property
    def processes(self) -> tuple[int, ...]:
        """Identifiers of the processes that run now."""
        return tuple(one for lane in self._all for one in lane.processes)

    def terminate(self) -> None:
        """End the processes at once, with the jobs that they run."""
        self._threads.shutdown(wait=False, cancel_futures=True)
        for process in self.processes:
            with contextlib.suppress(OSError):
                os.kill(process, signal.SIGTERM)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the processes after the jobs that they run."""
        self._threads.shutdown(wait=wait, cancel_futures=cancel_futures)
        for lane in self._all:
            lane.shutdown(wait)


class _Lane:
    """One process, which is started on use and again after its death."""

    def __init__(self, device: str) -> None:
        self._device, self._pool = device, _pool(device)

    @property
    def processes(self) -> tuple[int, ...]:
        # None until the first job.
        return tuple(self._pool._processes or ())

    def call(self, fn: Callable[..., Any], args: Any, kwargs: Any) -> Any:
        try:
            return self._pool.submit(fn, *args, **kwargs).result()
        except BrokenExecutor as error:
            self._pool.shutdown(wait=False)
            self._pool = _pool(self._device)
            raise WorkerDied("the process of the job ended") from error

    def shutdown(self, wait: bool) -> None:
        self._pool.shutdown(wait=wait, cancel_futures=True)


def _pool(device: str) -> ProcessPoolExecutor:
    # Drivers do not survive a fork.
    return ProcessPoolExecutor(
        1, mp_context=multiprocessing.get_context("spawn"), initializer=start_worker, initargs=(device,)
    )


def start_worker(device: str) -> None:
    """Set the device of a worker's process, which ends with its parent; Ctrl-C is the parent's."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()
    if device:
        os.environ[DEVICE] = device


def _end_with(sentinel: int) -> None:
    """Wait for the parent's end: a pool's process would wait for its next job for ever."""
    multiprocessing.connection.wait([sentinel])
    os._exit(1)
