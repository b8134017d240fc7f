"""Calls on single workers of a Dask cluster, one at a time on each, and the watch over these workers.

Dask would repeat a task whose worker has ended, and blame it on all tasks that wait there. So each call is a task for
one worker, which gets the next one after its answer: where that worker ends, only the caller repeats the call.
"""

from __future__ import annotations

import contextlib
import logging
import queue
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import BrokenExecutor, CancelledError, Future
from typing import Any, NamedTuple

from gpusense.sweeps import on_worker
from gpusense.sweeps.deaths import WorkerDied
from gpusense.sweeps.supervised import Limits, result_of
from gpusense.sweeps.worker import error_text

_LOG = logging.getLogger("gpusense")
# Seconds between two looks at the scheduler's list of workers.
LOOK = 1.0
# Seconds to wait for a finished call's result before asking whether it still exists, and how often.
_FETCH, _FETCHES = 2.0, 15


class Unusable(RuntimeError):
    """A Dask worker cannot run calls: it lacks a package, or has another version of one."""


class Call(NamedTuple):
    """A call that waits for a worker.

    Attributes:
        payload: Its pickle.
        future: Its result.
    """

    payload: bytes
    future: Future[Any]


class Link(NamedTuple):
    """Everything that calls on workers share.

    Attributes:
        client: The Dask client.
        name: Name of the executor.
        limits: Limits of a job.
        options: Of each Dask task: the resources that it takes.
        lost: Returns why there is no cluster any more, or an empty text.
    """

    client: Any
    name: str
    limits: Limits
    options: Mapping[str, Any]
    lost: Callable[[], str]


class RemoteWorker:
    """One Dask worker, as long as it lives.

    Args:
        link: To its cluster.
        address: Its address.
        place: Its folder, which no other worker has had.

    Attributes:
        address: It.
        place: It.
        gone: Set once the worker has left the cluster.
    """

    def __init__(self, link: Link, address: str, place: str) -> None:
        self._link = link
        self.address, self.place, self.gone = address, place, threading.Event()

    def call(self, payload: bytes, name: str = "") -> Any:
        """Run a call on the worker, and return its result or raise its error.

        Args:
            payload: The call.
            name: Of processes that run no other calls; those of the executor otherwise.

        Raises:
            OSError: the cluster has gone.
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

        The answer waits in the memory of its worker. Where that ends before the answer is fetched, the task is not
        repeated, as no other worker may run it.
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
        """Raise where the worker or its cluster has gone."""
        lost = self._link.lost()
        if lost:
            raise OSError(lost)
        if self.gone.is_set():
            raise WorkerDied(f"with its Dask worker at {self.address}", outside=True)

    def _failure(self, error: BaseException) -> Exception:
        """Return the meaning of a Dask task's own error; errors of jobs are answers."""
        import distributed

        self._check()
        if isinstance(error, distributed.scheduler.KilledWorker):
            return WorkerDied(f"with its Dask worker at {self.address}", outside=True)
        if isinstance(error, (CancelledError, distributed.CancelledError)):
            return CancelledError("the scheduler has lost the job")
        return Unusable(f"{self.address}: {error_text(error)}")


class Watch:
    """The workers of a cluster, as they come and go, each with a thread that hands it one call after the other.

    Args:
        link: To the cluster.
        workers: Returns the usable workers now: address and folder; None where the scheduler does not answer.
        ended: Returns why there is no scheduler any more, or an empty text.
        patience: Longest time without a worker, or without an answer of the scheduler [s].

    Attributes:
        lost: Why there is no cluster any more; empty as long as there is one.
        workers: The workers by their folders.
    """

    def __init__(
        self,
        link: Callable[[Watch], Link],
        workers: Callable[[], list[tuple[str, str]] | None],
        ended: Callable[[], str],
        patience: float,
    ) -> None:
        self.lost, self.workers = "", dict[str, RemoteWorker]()
        self._found, self._ended, self._patience = workers, ended, patience
        # Workers that cannot run calls, with the reasons.
        self._refused: dict[str, str] = {}
        self._calls: queue.SimpleQueue[Call] = queue.SimpleQueue()
        self._open, self._lock, self._end = set[Future[Any]](), threading.Lock(), threading.Event()
        self.link = link(self)
        self._match(workers() or [])
        self._thread = threading.Thread(target=self._look, name="gpusense-sweep-watch", daemon=True)
        self._thread.start()

    def submit(self, payload: bytes) -> Future[Any]:
        """Queue a call for the next free worker.

        Raises:
            RuntimeError: there is no cluster any more.
        """
        future: Future[Any] = Future()
        with self._lock:
            if self.lost:
                raise RuntimeError(self.lost)
            self._open.add(future)
            self._calls.put(Call(payload, future))
        future.add_done_callback(self._open.discard)
        return future

    def _return(self, call: Call) -> None:
        """Queue a call again, which its worker has not begun."""
        with self._lock:
            if not self.lost:
                self._calls.put(call)
                return
        _refuse(call, self.lost)

    @property
    def open(self) -> list[Future[Any]]:
        """Calls without a result."""
        with self._lock:
            return list(self._open)

    def lose(self, reason: str) -> None:
        """End all calls, and take none any more."""
        with self._lock:
            self.lost = self.lost or reason
        self._end.set()
        with contextlib.suppress(queue.Empty):
            while True:
                _refuse(self._calls.get_nowait(), self.lost)

    def _look(self) -> None:
        """Follow the workers of the cluster, until it is lost."""
        try:
            self._follow()
        except Exception as error:
            # Nothing may wait for a watch that has ended.
            _LOG.error("sweep: the workers could not be followed", exc_info=True)
            self.lose(f"the workers could not be followed: {error_text(error)}")

    def _follow(self) -> None:
        answered = present = time.monotonic()
        while not self._end.wait(LOOK):
            found, now = None if self._ended() else self._found(), time.monotonic()
            if found is None:
                silent = f"the scheduler has not answered for {self._patience:g} s"
                reason = self._ended() or (silent if now - answered > self._patience else "")
                if reason:
                    self.lose(reason)
                continue
            had, answered = bool(self.workers), now
            self._match(found)
            if self.workers:
                present = now
            elif now - present > self._patience:
                reasons = "".join(f"; left out: {reason}" for reason in self._refused.values())
                self.lose(f"no worker has been there for {self._patience:g} s{reasons}")
            elif had:
                _LOG.warning("sweep: no worker is left, waiting %g s for one", self._patience)

    def _match(self, found: list[tuple[str, str]]) -> None:
        """Take workers in that are new, and let those go that have left."""
        found = [one for one in found if one[1] not in self._refused]
        places = {place for _, place in found}
        for place in [place for place in self.workers if place not in places]:
            self.workers.pop(place).gone.set()
        for address, place in found:
            if place not in self.workers:
                worker = self.workers[place] = RemoteWorker(self.link, address, place)
                threading.Thread(target=self._serve, args=(worker,), name="gpusense-sweep", daemon=True).start()

    def _serve(self, worker: RemoteWorker) -> None:
        """Hand calls to a worker, one after the other, as long as it lives."""
        for call in self._taken(worker):
            if not _claimed(call):
                continue
            try:
                call.future.set_result(worker.call(call.payload))
            except Unusable as error:
                _LOG.warning("sweep: a worker is left out: %s", error)
                self._refused[worker.place] = str(error)
                worker.gone.set()
                self._return(call)
            except BaseException as error:
                call.future.set_exception(error)

    def _taken(self, worker: RemoteWorker) -> Iterator[Call]:
        while not worker.gone.is_set() and not self._end.is_set():
            with contextlib.suppress(queue.Empty):
                call = self._calls.get(timeout=LOOK)
                if self.lost:
                    _refuse(call, self.lost)
                elif worker.gone.is_set():
                    self._return(call)
                else:
                    yield call


def _claimed(call: Call) -> bool:
    """Tell whether a call is still wanted, and keep it from being cancelled; another worker may have claimed it."""
    return call.future.running() or call.future.set_running_or_notify_cancel()


def _refuse(call: Call, reason: str) -> None:
    """End a call that no worker has taken."""
    if _claimed(call):
        call.future.set_exception(OSError(reason))
