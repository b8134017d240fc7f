"""Supervise the process that runs an executor's jobs, within a Dask worker."""

from __future__ import annotations

import tempfile
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import BrokenExecutor
from pathlib import Path
from typing import Any

from gpusense.sweeps.supervised import Limits, Supervised, pickled
from gpusense.sweeps.worker import receive

# Pools of this process by worker and executor, since a cluster on one machine has several workers in a process.
_POOLS: dict[tuple[str, str], Pool] = {}
_LOCK = threading.Lock()
# Devices of the Dask workers in this process; other workers use the device of their environment.
DEVICES: dict[str, str] = {}

# An answer: its pickle, or the failure of the worker.
Answer = bytes | BrokenExecutor


class Pool:
    """Processes of a Dask worker for one executor; simultaneous jobs have a process each."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._free: list[Supervised] = []
        self._all: list[Supervised] = []
        self._first: list[bytes] = []
        self._folder: tempfile.TemporaryDirectory[str] | None = None

    def receive(self, contents: Mapping[str, Any]) -> None:
        """Keep maps and logs for each process; logs are stored as files, which outlive a process."""
        self._folder = tempfile.TemporaryDirectory(prefix="gpusense-sweep-")
        kept: dict[str, Any] = {}
        for index, (path, content) in enumerate(contents.items()):
            kept[path] = content
            if isinstance(content, bytes):
                # Only the suffixes are taken from the sender, since they select the format.
                kept[path] = Path(self._folder.name) / f"{index}{''.join(Path(path).suffixes[-2:])}"
                kept[path].write_bytes(content)
        self._first = [pickled(receive, (kept,), {})]

    def call(self, payload: bytes, limits: Limits, device: str, wanted: Callable[[], bool]) -> bytes:
        """Run a call in a process, and return the pickle of its answer."""
        with self._lock:
            if not self._free:
                self._free.append(Supervised(device, lambda: self._first))
                self._all.append(self._free[-1])
            process = self._free.pop()
        try:
            return process.call(payload, limits, wanted)
        finally:
            with self._lock:
                self._free.append(process)

    def close(self) -> None:
        """End the processes at once, together with their jobs."""
        with self._lock:
            processes = list(self._all)
        for one in processes:
            one.close(wait=False)
        if self._folder is not None:
            self._folder.cleanup()


def answer(executor: str, place: str, payload: bytes, limits: Limits) -> Answer | None:
    """Run a call in a process of the present Dask worker.

    Args:
        executor: Name of the executor.
        place: Folder of the intended worker, since Dask would repeat the call on a later worker with its address.
        payload: The call.
        limits: Limits of the job; the memory limit of the Dask worker also applies.

    Returns:
        The pickle of the result, the end of the process, or None if another worker was intended.
    """
    import distributed

    worker = distributed.get_worker()
    if worker.local_directory != place:
        return None
    task = worker.get_current_task()
    known = [one for one in (limits.memory, worker.memory_manager.memory_limit) if one]
    try:
        limits = limits._replace(memory=min(known, default=None))
        return pool_of(worker, executor).call(
            payload, limits, DEVICES.get(worker.id, ""), lambda: _wanted(worker, task)
        )
    except BrokenExecutor as error:
        return error


def _wanted(worker: Any, task: str) -> bool:
    """Tell whether a task of a Dask worker is still wanted; Dask forgets the tasks of a killed client."""
    try:
        return bool(worker.state.tasks[task].state == "executing")
    except KeyError:
        return False


def pool_of(worker: Any, executor: str) -> Pool:
    """Return the pool of a Dask worker for an executor."""
    with _LOCK:
        return _POOLS.setdefault((worker.id, executor), Pool())


def open_pool(worker: Any, executor: str, contents: Mapping[str, Any]) -> None:
    """Keep maps and logs for the jobs of an executor."""
    if contents:
        pool_of(worker, executor).receive(contents)


def close_pools(executor: str, worker: Any = None) -> None:
    """End the processes of an executor, including those of single workers, on one worker or on all in this process."""
    with _LOCK:
        keys = [key for key in _POOLS if key[1].startswith(executor) and (worker is None or key[0] == worker.id)]
        pools = [_POOLS.pop(key) for key in keys]
    for pool in pools:
        pool.close()
