"""Executors with the standard library's interface: in this process, in processes, or within Dask's workers.

``submit(function, *arguments)`` returns a ``concurrent.futures.Future``. Each has ``slots``, the number of jobs that it
runs at once. The death of a worker raises :class:`WorkerDied` in the future of its job, and the executor replaces the
worker.
"""

from __future__ import annotations

import pickle
import queue
import tempfile
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future, ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import Any

from gpusense._util import checks
from gpusense.sweeps.process import Worker, deafen, result_of


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


class Terminable(Executor):
    """Executor that ends its jobs at once if its ``with`` block ends by an exception."""

    def terminate(self) -> None:
        """End the running jobs."""
        raise NotImplementedError

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool | None:
        if kind is not None:
            self.terminate()
        return super().__exit__(kind, error, trace)


class ProcessExecutor(Terminable):
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
        self._seconds = None if job_timeout is None else checks.real("job_timeout", job_timeout, above=0)
        self._names = device_names(devices)
        self.slots = len(self._names)
        # A thread for each process hands it one job after another.
        self._threads = ThreadPoolExecutor(self.slots, "gpusense-sweep", deafen)
        self._free: queue.SimpleQueue[Worker] = queue.SimpleQueue()
        self._all = [Worker(name) for name in self._names]
        for one in self._all:
            self._free.put(one)

    def __repr__(self) -> str:
        return f"ProcessExecutor({self._names if any(self._names) else self.slots})"

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Queue a function of a module for the next free process."""
        return self._threads.submit(self._run, fn, args, kwargs)

    def _run(self, fn: Callable[..., Any], args: Any, kwargs: Any) -> Any:
        payload, worker = pickle.dumps((fn, args, kwargs)), self._free.get()
        try:
            return result_of(worker.call(payload, self._seconds))
        finally:
            self._free.put(worker)

    @property
    def processes(self) -> tuple[int, ...]:
        """Identifiers of the running processes."""
        return tuple(number for one in self._all for number in one.processes)

    def terminate(self) -> None:
        """End the processes at once, together with their jobs."""
        self._threads.shutdown(wait=False, cancel_futures=True)
        for one in self._all:
            one.close()

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the processes after their running jobs."""
        self._threads.shutdown(wait=wait, cancel_futures=cancel_futures)
        if wait:
            self.terminate()
        else:
            threading.Thread(target=self.shutdown, name="gpusense-sweep-end").start()


def device_names(devices: int | Sequence[str]) -> list[str]:
    """Return the selection string of each worker; empty strings for a number of workers."""
    if isinstance(devices, (str, bool)) or not isinstance(devices, (Sequence, int)):
        raise TypeError(f"devices: must be a number or selection strings, got {checks.show(devices)}")
    names = [""] * devices if isinstance(devices, int) else list(devices)
    if not names or not all(isinstance(name, str) for name in names):
        raise ValueError(f"devices: must be at least one worker, got {checks.show(devices)}")
    return names


# Processes by Dask worker and executor, since a cluster on one machine has several workers in a process.
_WORKERS: dict[tuple[str, str], tuple[Worker, tempfile.TemporaryDirectory[str]]] = {}
# Devices of the Dask workers of this process; other workers use the device of their environment.
DEVICES: dict[str, str] = {}


def take(worker: str, executor: str, contents: Mapping[str, Any]) -> None:
    """Keep maps and logs for an executor's process; logs are stored as files, which outlive a process."""
    folder = tempfile.TemporaryDirectory(prefix="gpusense-sweep-")
    sent = dict(contents)
    for index, (path, content) in enumerate(contents.items()):
        if isinstance(content, bytes):
            # Only the suffixes are taken from the sender, since they select the format.
            sent[path] = Path(folder.name) / f"{index}{''.join(Path(path).suffixes[-2:])}"
            sent[path].write_bytes(content)
    _WORKERS[worker, executor] = Worker(DEVICES.get(worker, ""), sent), folder


def leave(worker: str, executor: str) -> None:
    """End an executor's process, also during a job, and remove its files."""
    process, folder = _WORKERS.pop((worker, executor))
    process.close()
    folder.cleanup()


def answer(executor: str, payload: bytes, seconds: float | None) -> bytes:
    """Run a call of at most ``seconds`` in a process of the present Dask worker; return the pickle of its answer."""
    import distributed

    dask_worker = distributed.get_worker()
    task = dask_worker.get_current_task()

    def wanted() -> bool:
        """Return whether the task is still wanted; Dask forgets the tasks of a killed client."""
        state = dask_worker.state.tasks.get(task)
        return state is not None and state.state == "executing"

    try:
        return _WORKERS[dask_worker.id, executor][0].call(payload, seconds, wanted)
    except BrokenExecutor as error:
        return pickle.dumps((False, error))


def processes(name: str, contents: dict[str, Any]) -> Any:
    """Return the plugin of Dask workers that keeps an executor's process, with maps and the bytes of logs."""
    import distributed

    class Processes(distributed.WorkerPlugin):  # type: ignore[misc]
        """The process of an executor's jobs on a worker."""

        def setup(self, worker: Any) -> None:
            """Take the contents."""
            take(worker.id, name, contents)

        def teardown(self, worker: Any) -> None:
            """End the process, also during a job."""
            leave(worker.id, name)

    return Processes()


def one_start(name: str) -> Any:
    """Return the plugin of the scheduler that lets an executor's tasks fail with their Dask worker."""
    import distributed

    class OneStart(distributed.SchedulerPlugin):  # type: ignore[misc]
        """Let Dask repeat no job whose worker has ended: the sweep counts its starts."""

        async def start(self, scheduler: Any) -> None:
            """Keep the scheduler."""
            self.scheduler = scheduler

        def transition(self, key: Any, start: str, finish: str, *args: Any, **kwargs: Any) -> None:
            """Allow a job that goes to a worker no further failure."""
            if finish == "processing" and str(key).startswith(f"gpusense-{name}-"):
                self.scheduler.tasks[key].suspicious = self.scheduler.allowed_failures

    return OneStart()
