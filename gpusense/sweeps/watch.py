"""Watch the workers of a Dask cluster, and hand them calls."""

from __future__ import annotations

import contextlib
import logging
import queue
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from typing import Any, NamedTuple

from gpusense.sweeps.remote import LOOK, Found, Link, RemoteWorker, Unusable
from gpusense.sweeps.worker import error_text

_LOG = logging.getLogger("gpusense")


class Call(NamedTuple):
    """A call that waits for a worker.

    Attributes:
        payload: Pickle of the call.
        future: Future of its result.
    """

    payload: bytes
    future: Future[Any]


class Watch:
    """The present workers of a cluster, each with a thread that hands it one call after another.

    Args:
        link: Link to the cluster.
        workers: Returns the usable workers now; None if the scheduler does not answer.
        ended: Returns the reason why the scheduler has ended, or an empty string.
        patience: Longest time without a worker, or without an answer of the scheduler [s].

    Attributes:
        lost: Reason why the cluster is lost; empty while it exists.
        workers: The workers by their folders.
    """

    def __init__(
        self,
        link: Callable[[Watch], Link],
        workers: Callable[[], list[Found] | None],
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
            RuntimeError: the cluster is lost.
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
        """Queue again a call that its worker has not begun."""
        with self._lock:
            if not self.lost:
                self._calls.put(call)
                return
        _refuse(call, self.lost)

    @property
    def open(self) -> list[Future[Any]]:
        """Number of calls without a result."""
        with self._lock:
            return list(self._open)

    def lose(self, reason: str) -> None:
        """End all calls, and accept no further ones."""
        with self._lock:
            self.lost = self.lost or reason
        self._end.set()
        with contextlib.suppress(queue.Empty):
            while True:
                _refuse(self._calls.get_nowait(), self.lost)

    def _look(self) -> None:
        """Follow the workers of the cluster until it is lost."""
        try:
            self._follow()
        except Exception as error:
            # Nothing may wait for a finished watch.
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

    def _match(self, found: list[Found]) -> None:
        """Add new workers, and remove those that have left."""
        listed = {one.place: one for one in found if one.place not in self._refused}
        for place in [place for place in self.workers if place not in listed]:
            self.workers.pop(place).gone.set()
        for place, one in listed.items():
            if place in self.workers:
                self.workers[place].ready = one.ready
            elif one.ready:
                worker = self.workers[place] = RemoteWorker(self.link, one)
                threading.Thread(target=self._serve, args=(worker,), name="gpusense-sweep", daemon=True).start()

    def _serve(self, worker: RemoteWorker) -> None:
        """Hand calls to a worker one after another while it lives."""
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
            if not worker.ready:
                self._end.wait(LOOK)
                continue
            with contextlib.suppress(queue.Empty):
                call = self._calls.get(timeout=LOOK)
                if self.lost:
                    _refuse(call, self.lost)
                elif worker.gone.is_set():
                    self._return(call)
                else:
                    yield call


def _claimed(call: Call) -> bool:
    """Claim a call so that it cannot be cancelled; return whether it is still wanted and unclaimed."""
    return call.future.running() or call.future.set_running_or_notify_cancel()


def _refuse(call: Call, reason: str) -> None:
    """End a call that no worker has taken."""
    if _claimed(call):
        call.future.set_exception(OSError(reason))
