"""Jobs that end their workers or hang: failed rows, exact numbers of starts, no endless wait."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from concurrent.futures import Executor, Future
from importlib.util import find_spec
from pathlib import Path

import pytest
from support.sweep_tasks import alive, awaited, start_and_end, starts, swept

import gpusense as gs
from gpusense.sweep import Job, ProcessExecutor, SweepLost, WorkerDied
from gpusense.sweeps.process import death, work

LIMITS = dict(job_timeout=60)
ENGINES = [
    ProcessExecutor,
    pytest.param(
        lambda count, **limits: gs.sweep.DaskExecutor(devices=count, **limits),
        id="cluster",
        marks=pytest.mark.skipif(find_spec("distributed") is None, reason="needs gpusense[sweep]"),
    ),
]
# End of a job, the error of its row, and the number of its starts, of at most two.
ERRORS = {
    "segmentation fault": ("WorkerDied: the worker ended by SIGSEGV, 2 times", 2),
    "exit code 7": ("WorkerDied: the worker ended with exit code 7, 2 times", 2),
    "exit code 0": ("WorkerDied: the worker ended with exit code 0, 2 times", 2),
    "abort": ("WorkerDied: the worker ended by SIGABRT, 2 times", 2),
    "kill": ("WorkerDied: the worker ended by SIGKILL, 2 times", 2),
    "terminate": ("WorkerDied: the worker ended by SIGTERM, 2 times", 2),
    "fork": ("WorkerDied: the worker ended with exit code 9, 2 times", 2),
    "SystemExit": ("SystemExit: enough", 1),
    "KeyboardInterrupt": ("KeyboardInterrupt: ", 1),
    "unreadable": ("TypeError: cannot pickle '_thread.lock' object", 1),
}


def endings(folder, ends, count):
    """Return jobs whose first ones have these ends, each between sound jobs."""
    options = {"folder": str(folder)} | {f"end{2 * k}": end for k, end in enumerate(ends)}
    return [Job(task="support.sweep_tasks:ending", seed=seed, options=options) for seed in range(count)]


def check(folder, ends, jobs, ended, table, attempts=2):
    """Compare a table with the ends of its jobs."""
    errors = ERRORS if attempts == 2 else {end: (one[0].removesuffix(", 2 times"), 1) for end, one in ERRORS.items()}
    expected = [errors[ends[seed // 2]] if seed < 2 * len(ends) and seed % 2 == 0 else None for seed in table["seed"]]
    assert table["seed"] == list(range(len(jobs)))
    assert [one.strip() if one else None for one in table["error"]] == [one and one[0].strip() for one in expected]
    assert table["attempts"] == [one[1] if one else 1 for one in expected] == starts(folder, len(jobs))
    assert (ended.done, ended.failed) == (len(jobs) - len(ends), len(ends))
    assert ended.repeated == sum(table["attempts"]) - len(jobs)


@pytest.mark.sampled(0.5)
@pytest.mark.parametrize("engine", ENGINES)
def test_only_jobs_that_end_their_worker_fail(tmp_path, engine):
    ends = ["segmentation fault", "SystemExit", "kill"]
    jobs = endings(tmp_path, ends, 6)
    with engine(2, **LIMITS) as executor:
        ended, table = swept(jobs, tmp_path / "t.csv", executor, attempts=2)
    check(tmp_path, ends, jobs, ended, table)
    # A job that fails costs no other one, and may be tried again.
    ended, table = swept(jobs[:1], tmp_path / "t.csv", resume=True)
    assert (ended.skipped, ended.failed) == (1, 0) and len(table["seed"]) == 6


@pytest.mark.sampled(0.5)
@pytest.mark.parametrize("engine", ENGINES)
def test_a_job_that_hangs_is_ended_at_its_limit(tmp_path, engine):
    # Processes are tested with the harder case, in which no other thread of the worker runs.
    end = "hang in C" if engine is ProcessExecutor else "hang"
    jobs = endings(tmp_path, [end], 3)
    with engine(1, job_timeout=2) as executor:
        ended, table = swept(jobs, tmp_path / "t.csv", executor)
    assert (ended.done, ended.failed, ended.repeated) == (2, 1, 0) and table["attempts"] == [1] * 3
    assert table["error"] == ["JobTimeout: the worker was ended after the limit of 2 s", None, None]
    assert starts(tmp_path, 3) == [1] * 3


def test_other_ends_of_a_worker_are_rows(tmp_path):
    ends = ["abort", "fork", "KeyboardInterrupt", "unreadable", "terminate", "exit code 0"]
    jobs = endings(tmp_path, ends, 12)
    with ProcessExecutor(2, **LIMITS) as executor:
        ended, table = swept(jobs, tmp_path / "t.csv", executor, attempts=1)
    check(tmp_path, ends, jobs, ended, table, attempts=1)


def test_system_exit_of_a_job_is_a_row_in_this_process_too(tmp_path):
    ended, table = swept(endings(tmp_path, ["SystemExit"], 2), tmp_path / "t.csv")
    assert (ended.done, ended.failed) == (1, 1) and table["error"] == ["SystemExit: enough", None]
    with pytest.raises(KeyboardInterrupt):
        swept(endings(tmp_path, ["", "KeyboardInterrupt"], 4), tmp_path / "u.csv")
    assert gs.sweep.read_table(tmp_path / "u.csv")["seed"] == [0, 1]


@pytest.mark.parametrize("engine", ENGINES)
def test_an_interrupt_keeps_what_has_ended_and_ends_what_runs(tmp_path, engine):
    jobs = endings(tmp_path, ["", "", "hang"], 6)
    seen, processes = [], []

    def interrupt(row):
        seen.append(row["seed"])
        # Jobs 0 to 3 have ended, and job 4 hangs; the rows of two or more are not yet there.
        awaited(lambda: (tmp_path / "starts").exists() and starts(tmp_path, 5)[4])
        processes.extend(int(one) for one in running_children())
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), engine(1) as executor:
        swept(jobs, tmp_path / "t.csv", executor, window=5, on_row=lambda row: seen or interrupt(row))
    assert set(range(4)) <= set(gs.sweep.read_table(tmp_path / "t.csv")["seed"]) and len(processes) == 1
    awaited(lambda: not any(map(alive, processes)))


def running_children():
    """Return the workers of this process: each leads a session."""
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            if int(fields[1]) == os.getpid() and fields[3] == entry.name and fields[0] != "Z":
                yield entry.name


def test_what_a_job_has_started_ends_with_its_worker(tmp_path):
    with ProcessExecutor(1) as executor:
        started = executor.submit(start_and_end, str(tmp_path))
        with pytest.raises(WorkerDied, match="with exit code 3"):
            started.result(timeout=60)
    awaited(lambda: not alive(int((tmp_path / "process").read_text())))


def test_a_worker_that_ends_between_jobs_is_charged_to_none(tmp_path):
    jobs = endings(tmp_path, [], 2)
    with ProcessExecutor(1) as executor:
        swept(jobs[:1], tmp_path / "t.csv", executor)
        for process in executor.processes:
            os.kill(process, signal.SIGKILL)
        ended, table = swept(jobs, tmp_path / "t.csv", executor, resume=True, attempts=1)
    assert (ended.done, ended.repeated) == (1, 0) and table["attempts"] == [1, 1] and starts(tmp_path, 2) == [1, 1]


def test_workers_that_cannot_start_end_the_sweep(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONHOME", str(tmp_path / "nowhere"))
    with (
        ProcessExecutor(1) as executor,
        pytest.raises(SweepLost, match=r"must start .* got 3 that ended with exit code"),
    ):
        swept(endings(tmp_path, [], 2), tmp_path / "t.csv", executor)


def test_a_hanging_worker_ends_with_a_parent_that_is_killed(tmp_path):
    code = "\n".join([
        "import gpusense as gs, os, sys, time", "if __name__ == '__main__':",
        "    ex = gs.sweep.ProcessExecutor(1)", "    print(ex.submit(os.getpid).result(), flush=True)",
        # It never lets another thread of the worker run.
        "    ex.submit(pow, 3, 1 << 31)", "    time.sleep(1)", "    print('runs', flush=True)", "    time.sleep(60)",
    ])  # fmt: skip
    (tmp_path / "main.py").write_text(code)
    path = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen([sys.executable, str(tmp_path / "main.py")], stdout=subprocess.PIPE, env=path) as parent:
        worker = int(parent.stdout.readline())
        parent.stdout.readline()
        parent.kill()
    try:
        awaited(lambda: not alive(worker))
    finally:
        if alive(worker):
            os.kill(worker, signal.SIGKILL)


class Crowded(Executor):
    """An executor that runs two jobs at a time, and lets one of them die at its first two starts."""

    slots = 2

    def __init__(self, victim):
        self.victim, self.started, self._waiting = victim, [], []

    def submit(self, fn, /, *args, **kwargs):
        future = Future()
        self.started.append(args[0].seed)
        self._waiting.append(future)
        self.crowd = sum(not one.done() for one in self._waiting)
        ends = args[0].seed == self.victim and self.started.count(self.victim) < 3
        threading.Timer(0.02, self._run, (future, args, ends)).start()
        return future

    def _run(self, future, args, ends):
        if ends:
            future.set_exception(WorkerDied("by SIGKILL", outside=True))
        else:
            future.set_result(work(*args))


def test_the_last_start_after_an_end_from_outside_is_alone(tmp_path):
    jobs = [Job(task="support.sweep_tasks:plain", seed=seed) for seed in range(12)]
    crowded = Crowded(victim=1)
    ended, table = swept(jobs, tmp_path / "t.csv", crowded, attempts=3, window=4)
    assert (ended.done, ended.failed) == (12, 0), table["error"]
    assert crowded.started[-1] == 1 and crowded.crowd == 1
    assert table["attempts"][1] == crowded.started.count(1) == 3


def test_workers_have_one_thread_for_linear_algebra_unless_the_environment_says_otherwise(monkeypatch):
    """Jobs run side by side; the environment of this process stays as it was."""
    names = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    monkeypatch.setenv("MKL_NUM_THREADS", "")
    before = dict(os.environ)
    with ProcessExecutor(1) as executor:
        assert [executor.submit(os.getenv, name).result() for name in names] == ["1", "3", ""]
    assert dict(os.environ) == before


def test_an_end_is_described():
    assert {code: str(death(code)) for code in (-11, 3, 0xC0000005, -40, None, -9)} == {
        -11: "the worker ended by SIGSEGV",
        3: "the worker ended with exit code 3",
        0xC0000005: "the worker ended with exit code 0xc0000005",
        -40: "the worker ended by signal 40",
        None: "the worker ended for an unknown reason",
        -9: "the worker ended by SIGKILL",
    }
    assert death(-9).outside and not death(-11).outside


def test_limits_are_checked():
    for limits, message in (
        (dict(job_timeout=0), "job_timeout: must be finite and > 0, got 0"),
        (dict(job_timeout="1"), "job_timeout: must be a real number"),
    ):
        with pytest.raises((TypeError, ValueError), match=message):
            ProcessExecutor(1, **limits)
