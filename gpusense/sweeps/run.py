"""Run the jobs of a sweep on an executor, append a row as soon as each ends, and resume after a crash."""

from __future__ import annotations

import os
import secrets
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gpusense._util import checks
from gpusense.sweeps.executors import SerialExecutor
from gpusense.sweeps.job import Job
from gpusense.sweeps.process import JobTimeout, Outcome, WorkerDied, error_text, work
from gpusense.sweeps.table import DONE, FAILED, Row, Table

# Queued jobs per slot of an executor, to keep it busy.
_QUEUED = 2
# Time for results in transit when a sweep is interrupted [s].
_ARRIVE = 0.5


class SweepLost(ConnectionError):
    """The executor has ended before the sweep; its finished jobs are in the table."""


@dataclass(frozen=True)
class Sweep:
    """Summary of a finished sweep.

    Attributes:
        table: The table's CSV file.
        jobs: Jobs of the sweep.
        done: Number of jobs that ran and succeeded.
        failed: Number of jobs that ran and failed; their rows state the error.
        skipped: Number of jobs whose rows were already in the table.
        repeated: Number of starts that ended with their worker and were repeated.

    Example:
        >>> import gpusense as gs
        >>> gs.sweep.Sweep(table="sweep.csv", jobs=3, done=2, failed=0, skipped=1, repeated=0).done
        2
    """

    table: str
    jobs: int
    done: int
    failed: int
    skipped: int
    repeated: int


def run(
    jobs: Iterable[Job],
    *,
    table: str | os.PathLike[str],
    executor: Executor | None = None,
    root: str | os.PathLike[str] = ".",
    backend: str = "auto",
    resume: bool = False,
    retry_failed: bool = False,
    attempts: int = 3,
    window: int | None = None,
    on_row: Callable[[Row], None] = lambda row: None,
) -> Sweep:
    """Run jobs, and append a row to a table as soon as each ends.

    A job that raises, even ``SystemExit``, becomes a row with its error. A job whose worker ends is started again, up
    to ``attempts`` times; then its row has the end of the worker as its error. A job that has exceeded the executor's
    ``job_timeout`` is not started again. If the cause of an end may lie outside the job (SIGKILL, a lost machine), its
    last start comes after all other jobs and alone, so that no job fails because of its neighbours. If the executor
    itself ends, or after Ctrl-C, finished jobs stay in the table, and ``resume=True`` runs the remaining jobs.

    Args:
        jobs: The jobs; equal ones run once.
        table: A ``.csv`` or ``.parquet`` file. Rows come in the order in which jobs end, and in the order of
            the jobs once all have ended.
        executor: An executor with the interface of ``concurrent.futures.Executor``, such as :class:`ProcessExecutor` or
            :class:`DaskExecutor`; it is not shut down. None runs the jobs in this process, and a job that ends it
            ends the sweep.
        root: Folder of maps and logs, on the machine of each worker unless they are sent.
        backend: Selection string of the device, for workers without a chosen device.
        resume: Keep the rows of an existing table, and skip their jobs.
        retry_failed: Run failed jobs of the table again.
        attempts: Most starts of a job whose worker ends.
        window: Jobs that are submitted at once; two for each slot of the executor by default.
        on_row: Called with each new row.

    Raises:
        FileExistsError: the table exists, and ``resume`` is false.
        SweepLost: The executor has ended.
        TypeError, ValueError: an argument breaks its rule.

    Example:
        >>> import gpusense as gs, tempfile, pathlib
        >>> jobs = [gs.sweep.Job(task="builtins:dir", seed=seed) for seed in (0, 1)]
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     ended = gs.sweep.run(jobs, table=pathlib.Path(folder) / "sweep.csv")
        >>> ended.failed
        2
    """
    unique = {job.key: job for job in jobs}
    most = checks.integer("attempts", attempts, low=1)
    chosen = SerialExecutor() if executor is None else executor
    size = 1 if isinstance(chosen, SerialExecutor) else window
    if size is not None:
        size = checks.integer("window", size, low=1)
    with Table(table, resume=resume) as rows:
        kept = {key for key, row in rows.rows.items() if row["status"] == DONE or not retry_failed}
        pending = [job for job in unique.values() if job.key not in kept]
        counts: Counter[str] = Counter()
        setting = str(Path(root).resolve()), backend, secrets.token_hex(8)
        starts = Starts(pending, lambda job: chosen.submit(work, job, *setting), most)

        def record(job: Job, outcome: Outcome, number: int) -> None:
            row = rows.add(job, outcome, number)
            counts[row["status"]] += 1
            counts["repeated"] += number - 1
            on_row(row)

        try:
            for ended in starts.ended(lambda: size or _window(chosen)):
                record(*ended)
        except (KeyboardInterrupt, SweepLost):
            # Keep the results of finished jobs.
            for ended in starts.left():
                record(*ended)
            raise
        finally:
            starts.cancel()
            rows.finish(list(unique))
        skipped = len(unique) - len(pending)
        return Sweep(str(rows.path), len(unique), counts[DONE], counts[FAILED], skipped, counts["repeated"])


def _window(executor: Executor) -> int:
    return int(getattr(executor, "window", _QUEUED * getattr(executor, "slots", os.cpu_count() or 1)))


Ended = tuple[Job, Outcome, int]
"""A job, its result, and the number of its starts."""


class Starts:
    """The jobs of a sweep as they pass through an executor; a job starts at most ``most`` times."""

    def __init__(self, jobs: Iterable[Job], submit: Callable[[Job], Future[Any]], most: int) -> None:
        self._submit, self._most = submit, most
        self._waiting = deque((job, 0) for job in jobs)
        # Jobs whose last start must be alone.
        self._suspects: deque[tuple[Job, int]] = deque()
        self._running: dict[Future[Any], tuple[Job, int]] = {}

    def ended(self, window: Callable[[], int]) -> Iterator[Ended]:
        """Yield the jobs in the order in which they end; raise SweepLost if the executor has ended."""
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
                # Remove the future last, to keep the job if writing its row was interrupted.
                del self._running[future]

    def left(self) -> Iterator[Ended]:
        """Yield the jobs with a result but no row, at the end of a sweep."""
        wait(self._running, _ARRIVE)
        for future in [one for one in self._running if one.done() and not one.cancelled()]:
            if future.exception() is None:
                job, starts = self._running[future]
                yield job, future.result(), starts
            del self._running[future]

    def cancel(self) -> None:
        """Cancel the jobs that have not begun."""
        for future in self._running:
            future.cancel()

    def _start(self, jobs: deque[tuple[Job, int]]) -> None:
        job, starts = jobs[0]
        try:
            self._running[self._submit(job)] = (job, starts + 1)
        except (RuntimeError, OSError, CancelledError) as error:
            raise SweepLost(f"executor: must take jobs, got {error_text(error)}") from error
        jobs.popleft()

    def _ended(self, future: Future[Any]) -> Ended | None:
        """Return the end of a job; None if it is started again."""
        job, starts = self._running[future]
        error = CancelledError("a job was cancelled") if future.cancelled() else future.exception()
        if error is None:
            return job, future.result(), starts
        if isinstance(error, WorkerDied):
            if isinstance(error, JobTimeout) or starts >= self._most:
                times = f", {starts} times" if starts > 1 else ""
                return job, Outcome({}, f"{type(error).__name__}: {error}{times}"), starts
            last = error.outside and starts + 1 == self._most
            (self._suspects if last else self._waiting).appendleft((job, starts))
            return None
        if isinstance(error, (BrokenExecutor, CancelledError, OSError)):
            raise SweepLost(f"executor: has ended before the sweep: {error_text(error)}") from error
        # The job's result cannot be sent, or its worker cannot run it.
        return job, Outcome({}, error_text(error)), starts
