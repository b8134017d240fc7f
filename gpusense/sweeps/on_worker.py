"""Run jobs within a Dask worker, in a process for each executor, and keep the maps and logs that were sent to it."""

from __future__ import annotations

import pickle
import tempfile
from collections.abc import Mapping
from concurrent.futures import BrokenExecutor
from pathlib import Path
from typing import Any

from gpusense.sweeps.process import Worker

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
