"""Count the starts of a sweep's jobs; each start ends with a row or with another start."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Future, wait
from typing import Any, NamedTuple

from gpusense.sweeps.deaths import JobTimeout, WorkerDied
from gpusense.sweeps.job import Job
from gpusense.sweeps.worker import Outcome, error_text


class SweepLost(ConnectionError):
    """The executor has ended before the sweep; its finished jobs are in the table."""


class Ended(NamedTuple):
    """A job that has ended.

    Attributes:
        job: The job.
        outcome: Result of the job.
        starts: Number of starts.
    """

    job: Job
    outcome: Outcome
    starts: int


class Starts:
    """The jobs of a sweep as they pass through an executor.

    Args:
        jobs: The jobs.
        submit: Starts a job, and returns the future of its outcome.
        most: Most starts of a job.
    """

    def __init__(self, jobs: Iterable[Job], submit: Callable[[Job], Future[Any]], most: int) -> None:
        self._submit, self._most = submit, most
        self._waiting = deque((job, 0) for job in jobs)
        # Jobs whose last start must be alone.
        self._suspects: deque[tuple[Job, int]] = deque()
        self._running: dict[Future[Any], tuple[Job, int]] = {}

    def ended(self, window: Callable[[], int]) -> Iterator[Ended]:
        """Yield the jobs in the order in which they end.

        Args:
            window: Returns the jobs to submit at once.

        Raises:
            SweepLost: the executor has ended.
        """
        while self._waiting or self._suspects or self._running:
            limit = window()
            while self._waiting and len(self._running) < limit:
                self._start(self._waiting)
            if not self._running:
                self._start(self._suspects)
            for future in wait(self._running, return_when=FIRST_COMPLETED).done:
                ended = self._ended(future)
                if ended is not None:
                    yield ended
                # Remove it only now, so that the job is kept if writing its row was interrupted.
                del self._running[future]

    def left(self) -> Iterator[Ended]:
        """Yield the jobs with a result but no row, at the end of a sweep."""
        for future in [one for one in self._running if one.done() and not one.cancelled()]:
            if future.exception() is None:
                yield Ended(self._running[future][0], future.result(), self._running[future][1])
            del self._running[future]

    def cancel(self) -> None:
        """Cancel the jobs that have not begun."""
        for future in self._running:
            future.cancel()

    def _start(self, jobs: deque[tuple[Job, int]]) -> None:
        job, starts = jobs[0]
        self._running[self._submit(job)] = (job, starts + 1)
        jobs.popleft()

    def _ended(self, future: Future[Any]) -> Ended | None:
        """Return the end of a job; None if it is started again.

        Raises:
            SweepLost: the executor has ended.
        """
        job, starts = self._running[future]
        error = CancelledError("a job was cancelled") if future.cancelled() else future.exception()
        if error is None:
            return Ended(job, future.result(), starts)
        if isinstance(error, WorkerDied):
            if isinstance(error, JobTimeout) or starts >= self._most:
                return Ended(job, _death(error, starts), starts)
            last = error.outside and starts + 1 == self._most
            (self._suspects if last else self._waiting).appendleft((job, starts))
            return None
        if isinstance(error, (BrokenExecutor, CancelledError, OSError)):
            raise SweepLost(f"executor: has ended before the sweep: {error_text(error)}") from error
        # The job's result cannot be sent, or its worker cannot run it.
        return Ended(job, _failed(error_text(error)), starts)


def _death(error: WorkerDied, starts: int) -> Outcome:
    """Return the outcome of a job whose worker has ended."""
    times = f", {starts} times" if starts > 1 else ""
    memory = {"memory_mb": round(error.memory / 1e6, 1)} if error.memory else {}
    return _failed(f"{type(error).__name__}: {error}{times}", memory)


def _failed(error: str, values: dict[str, Any] | None = None) -> Outcome:
    return Outcome(values or {}, error, "", 0.0, 0.0, "", "")
