"""Run calls on single workers of a Dask cluster, one at a time on each.

Dask would repeat a task whose worker has ended, and charge the end to all tasks that wait there. So each call is a task
for one worker, which gets the next call after its answer. If the worker ends, only the caller repeats the call.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from concurrent.futures import BrokenExecutor, CancelledError
from typing import Any, NamedTuple

from gpusense.sweeps import on_worker
from gpusense.sweeps.deaths import WorkerDied
from gpusense.sweeps.supervised import Limits, result_of
from gpusense.sweeps.worker import error_text

# Seconds between two checks of the scheduler's list of workers.
LOOK = 1.0
# Seconds to wait for a finished call's result before asking whether it still exists, and how often.
_FETCH, _FETCHES = 2.0, 15


class Unusable(RuntimeError):
    """A Dask worker cannot run calls, because it lacks a package or has another version of it."""


class Found(NamedTuple):
    """A worker in the scheduler's list.

    Attributes:
        address: Address of the worker.
        place: Folder of the worker, which no other worker has had.
        ready: Whether it starts tasks; a pausing or retiring worker only finishes its running ones.
    """

    address: str
    place: str
    ready: bool


class Link(NamedTuple):
    """Everything that is common to calls on workers.

    Attributes:
        client: The Dask client.
        name: Name of the executor.
        limits: Limits of a job.
        options: Options of each Dask task: the resources that it takes.
        lost: Returns the reason why the cluster is lost, or an empty string.
    """

    client: Any
    name: str
    limits: Limits
    options: Mapping[str, Any]
    lost: Callable[[], str]


class RemoteWorker:
    """One Dask worker during its lifetime.

    Args:
        link: Link to its cluster.
        found: The worker.

    Attributes:
        address: Address of the worker.
        place: Folder of the worker.
        ready: Whether it begins tasks.
        gone: Set once the worker has left the cluster.
    """

    def __init__(self, link: Link, found: Found) -> None:
        self._link = link
        self.address, self.place, self.ready = found
        self.gone = threading.Event()

    def call(self, payload: bytes, name: str = "") -> Any:
        """Run a call on the worker, and return its result or raise its error.

        Args:
            payload: The call.
            name: Name of processes reserved for these calls; empty for the executor's processes.

        Raises:
            OSError: the cluster is lost.
            WorkerDied: the process of the call, or the Dask worker, has ended.
        """
        link = self._link
        remote = link.client.submit(
            on_worker.answer, name or link.name, self.place, payload, link.limits,
            workers=[self.address], allow_other_workers=False, pure=False, retries=0, **link.options,
        )  # fmt: skip
        try:
            answer = self._awaited(remote)
        finally:
            remote.release()
        if answer is None:
            raise WorkerDied(f"with its Dask worker at {self.address}", outside=True)
        if isinstance(answer, BrokenExecutor):
            raise answer
        return result_of(answer)

    def _awaited(self, remote: Any) -> on_worker.Answer | None:
        """Return the answer of a task.

        The answer waits in the memory of its worker. If the worker ends before the answer is fetched, the task is not
        repeated, since no other worker may run it.
        """
        done = threading.Event()
        remote.add_done_callback(lambda _: done.set())
        while not done.wait(LOOK) and remote.status == "pending":
            self._check()
        for _ in range(_FETCHES):
            try:
                answer: on_worker.Answer | None = remote.result(timeout=_FETCH)
                return answer
            except TimeoutError:
                self._check()
                if remote.status not in ("finished", "pending"):
                    break
            except BaseException as error:
                raise self._failure(error) from error
        raise WorkerDied("before its result was fetched", outside=True)

    def _check(self) -> None:
        """Raise an error if the worker or its cluster is gone."""
        lost = self._link.lost()
        if lost:
            raise OSError(lost)
        if self.gone.is_set():
            raise WorkerDied(f"with its Dask worker at {self.address}", outside=True)

    def _failure(self, error: BaseException) -> Exception:
        """Translate a Dask task's error; errors of jobs arrive as answers instead."""
        import distributed

        self._check()
        if isinstance(error, distributed.scheduler.KilledWorker):
            return WorkerDied(f"with its Dask worker at {self.address}", outside=True)
        if isinstance(error, (CancelledError, distributed.CancelledError)):
            return CancelledError("the scheduler has lost the job")
        return Unusable(f"{self.address}: {error_text(error)}")
