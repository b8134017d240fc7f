"""Run the jobs of a sweep on an executor, append a row for each, and resume after a crash."""

from __future__ import annotations

import os
import secrets
from collections import Counter, deque
from collections.abc import Callable, Iterable
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gpusense._util import checks
from gpusense.sweeps.executors import SerialExecutor, WorkerDied
from gpusense.sweeps.job import Job
from gpusense.sweeps.table import DONE, FAILED, Row, Table
from gpusense.sweeps.worker import Outcome, work

# Jobs that wait for each slot of an executor, so that it never idles.
_QUEUED = 2


class SweepLost(ConnectionError):
    """The executor has ended before the sweep; its finished jobs are in the table."""


@dataclass(frozen=True)
class Sweep:
    """A sweep that has ended.

    Attributes:
        table: The table's CSV file.
        jobs: Jobs of the sweep.
        done: Jobs that ran now and succeeded.
        failed: Jobs that ran now and failed; their rows have the error.
        skipped: Jobs whose rows were in the table already.
        repeated: Runs that ended with their worker and were started again.

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

    A job that raises becomes a row with its error. A job whose worker ends is started again. If the executor itself
    ends, finished jobs stay in the table, and ``resume=True`` runs the others.

    Args:
        jobs: The jobs; equal ones run once.
        table: A ``.csv`` or ``.parquet`` file. Rows come in the order in which jobs end, and in the order of
            the jobs once all have ended.
        executor: Of the shape of ``concurrent.futures.Executor``, such as :class:`ProcessExecutor` or
            :class:`DaskExecutor`; None runs the jobs here. It is not shut down.
        root: Folder of maps and logs, on the machine of each worker unless they are sent.
        backend: Selection string of the device of workers that have none of their own.
        resume: Keep the rows of an existing table, and skip their jobs.
        retry_failed: Run failed jobs of the table again.
        attempts: Most starts of a job whose worker ends.
        window: Jobs that are submitted at once; two for each slot of the executor by default.
        on_row: Called with each new row.

    Raises:
        FileExistsError: the table exists, and ``resume`` is false.
        SweepLost: the executor has ended.
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
        pending = deque(job for job in unique.values() if job.key not in kept)
        left = len(pending)
        counts: Counter[str] = Counter()
        setting = str(Path(root).resolve()), backend, secrets.token_hex(8)
        try:
            for job, outcome, tries in _outcomes(pending, chosen, size, most, setting):
                row = rows.add(job, outcome, tries)
                counts[row["status"]] += 1
                counts["repeated"] += tries - 1
                on_row(row)
        finally:
            rows.finish(list(unique))
        return Sweep(str(rows.path), len(unique), counts[DONE], counts[FAILED], len(unique) - left, counts["repeated"])


def _outcomes(
    pending: deque[Job], executor: Executor, size: int | None, most: int, setting: tuple[str, ...]
) -> Iterable[tuple[Job, Outcome, int]]:
    """Yield each job with its outcome and the number of its starts, in the order in which they end.

    Raises:
        SweepLost: the executor has ended.
    """
    running: dict[Future[Any], tuple[Job, int]] = {}
    again: deque[tuple[Job, int]] = deque()
    error: SweepLost | None = None
    try:
        while pending or again or running:
            limit = size or _window(executor)
            while (pending or again) and len(running) < limit:
                job, tries = again.popleft() if again else (pending.popleft(), 0)
                running[_submitted(executor, job, setting)] = (job, tries + 1)
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                job, tries = running.pop(future)
                try:
                    outcome = _outcome(future)
                except SweepLost as lost:
                    # Others of this round may have finished.
                    error = lost
                    continue
                if outcome is None and tries < most:
                    again.append((job, tries))
                    continue
                died = Outcome({}, f"WorkerDied: the worker ended, {tries} times", "", 0.0, 0.0, "", "")
                yield job, outcome or died, tries
            if error is not None:
                raise error
    finally:
        for future in running:
            future.cancel()


def _window(executor: Executor) -> int:
    """Return the jobs to submit at once, which follow the workers of a cluster that grows or shrinks."""
    try:
        return _QUEUED * max(int(getattr(executor, "slots", os.cpu_count() or 1)), 1)
    except (OSError, RuntimeError, TimeoutError) as error:
        raise SweepLost(f"executor: must answer, got {type(error).__name__}: {error}") from error


def _submitted(executor: Executor, job: Job, setting: tuple[str, ...]) -> Future[Any]:
    try:
        return executor.submit(work, job, *setting)
    except (RuntimeError, OSError, CancelledError) as error:
        raise SweepLost(f"executor: must take jobs, got {type(error).__name__}: {error}") from error


def _outcome(future: Future[Any]) -> Outcome | None:
    """Return the outcome of a job; None where its worker has ended.

    Raises:
        SweepLost: the executor has ended.
    """
    try:
        outcome: Outcome = future.result()
        return outcome
    except WorkerDied:
        return None
    except (BrokenExecutor, CancelledError, OSError) as error:
        raise SweepLost(f"executor: has ended before the sweep: {type(error).__name__}: {error}") from error
