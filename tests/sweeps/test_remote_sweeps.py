"""Sweeps on a Dask cluster that gpusense did not start: supervision, reports and TLS."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from support.command_line import error_of
from support.paths import ROOT
from support.sweep_tasks import alive, awaited, sent_text, starts, swept

import gpusense as gs
from gpusense.commands import cli
from gpusense.sweep import Job, SweepLost


class Cluster:
    """A scheduler with workers.

    Args:
        folder: For the scheduler's file.
        workers: Arguments of each worker's command besides the address.
        scheduler: Arguments of the scheduler's command.
        environment: Variables of all processes.
    """

    def __init__(self, folder, workers, *, scheduler=(), environment=None):
        path = {"PYTHONPATH": os.pathsep.join(sys.path), "DASK_LOGGING__DISTRIBUTED": "error"}
        self._environment = os.environ | path | (environment or {})
        file = Path(folder) / "scheduler.json"
        self.workers = []
        self.scheduler = self._start("dask_scheduler", "--port", "0", "--dashboard-address", "127.0.0.1:0",
                                     "--scheduler-file", str(file), *scheduler)  # fmt: skip
        try:
            awaited(lambda: self.scheduler.poll() is not None or (file.exists() and file.read_text().endswith("}")))
            self.address = json.loads(file.read_text())["address"]
            for one in workers:
                self.add(*one)
        except BaseException:
            self.close()
            raise

    def add(self, *arguments):
        """Start a worker, and return its process."""
        program = ("dask_worker", self.address, "--nthreads", "1", "--no-dashboard", *arguments)
        self.workers.append(self._start(*program))
        return self.workers[-1]

    def _start(self, program, *arguments):
        command = [sys.executable, "-m", f"distributed.cli.{program}", *arguments]
        command += [] if "--host" in arguments else ["--host", "127.0.0.1"]
        quiet = dict(stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        return subprocess.Popen(command, env=self._environment, **quiet)

    def close(self):
        """End all processes; a nanny ends its worker instead of letting it wait for the scheduler."""
        for process in (self.scheduler, *self.workers):
            nanny = process is not self.scheduler and "--no-nanny" not in process.args
            (process.terminate if nanny else process.kill)()
        for process in (self.scheduler, *self.workers):
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(10)
            process.kill()
            process.wait()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()


def write_certificates(folder):
    """Write ``ca.pem``, and ``cert.pem`` signed by it with ``key.pem``, by the page's commands; return their paths."""
    if shutil.which("openssl") is None:
        pytest.skip("needs the command openssl")
    folder.mkdir(exist_ok=True)
    blocks = (ROOT / "docs" / "sweeps.md").read_text().split("```sh\n")
    (commands,) = (one for one in blocks if one.startswith("openssl"))
    subprocess.run(["sh", "-ec", commands.split("```")[0]], cwd=folder, check=True, capture_output=True)
    return tuple(str(folder / name) for name in ("ca.pem", "cert.pem", "key.pem"))


distributed = pytest.importorskip("distributed", reason="needs gpusense[sweep]")

DEVICE = ("--resources", "gpusense=1")
PLAIN = (*DEVICE, "--no-nanny", "--memory-limit", "0")


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """Return a cluster of a worker that a nanny restarts."""
    with Cluster(tmp_path_factory.mktemp("dask"), [DEVICE]) as cluster:
        yield cluster


@pytest.fixture(scope="module")
def executor(cluster):
    with gs.sweep.DaskExecutor(cluster.address, timeout=60) as executor:
        yield executor


def made(name, count, folder, **options):
    return [Job(task=f"support.sweep_tasks:{name}", seed=seed, options={"folder": str(folder)} | options)
            for seed in range(count)]  # fmt: skip


def test_workers_of_others_supervise_their_jobs(tmp_path, executor):
    ends = {"end0": "segmentation fault", "end1": "exit code 7", "end2": "SystemExit"}
    ended, table = swept(made("ending", 4, tmp_path, **ends), tmp_path / "t.csv", executor, attempts=2)
    assert (ended.done, ended.failed, ended.repeated) == (1, 3, 2)
    assert table["error"] == [
        "WorkerDied: the worker ended by SIGSEGV, 2 times",
        "WorkerDied: the worker ended with exit code 7, 2 times",
        "SystemExit: enough",
        None,
    ]
    assert table["attempts"] == [2, 2, 1, 1] == starts(tmp_path, 4)


def test_a_dask_worker_that_ends_costs_one_start(tmp_path, executor):
    jobs = made("ended_from_above", 3, tmp_path)
    ended, table = swept(jobs, tmp_path / "t.csv", executor)
    assert (ended.done, ended.failed, ended.repeated) == (3, 0, 1), table["error"]
    assert table["attempts"] == [1, 2, 1] == starts(tmp_path, 3)


def test_executors_on_one_cluster_keep_apart_and_leave_nothing(tmp_path, cluster, executor):
    executor.send({"a.txt": b"one"})
    with gs.sweep.DaskExecutor(cluster.address, timeout=60) as other:
        other.send({"a.txt": b"other"})
        texts = [one.submit(sent_text, "a.txt").result(timeout=60) for one in (executor, other)]
        assert texts == ["one", "other"]
        process = other.submit(os.getpid).result(timeout=60)
    awaited(lambda: not alive(process))
    own = executor.submit(os.getpid).result(timeout=60)
    with pytest.raises(KeyboardInterrupt), gs.sweep.DaskExecutor(cluster.address, timeout=60) as other:
        process = other.submit(os.getpid).result(timeout=60)
        other.submit(time.sleep, 600)
        raise KeyboardInterrupt
    awaited(lambda: not alive(process))
    assert alive(own)


def test_a_job_of_a_client_that_has_gone_does_not_hold_its_worker(cluster, executor):
    other = gs.sweep.DaskExecutor(cluster.address, timeout=60)
    process = other.submit(os.getpid).result(timeout=60)
    other.submit(time.sleep, 600)
    time.sleep(0.5)
    # Only its connection shows that a client was killed.
    other._client.close()
    awaited(lambda: not alive(process))
    assert executor.submit(abs, -4).result(timeout=60) == 4
    other.terminate()


@pytest.mark.long
def test_a_cluster_without_workers_ends_the_sweep(tmp_path, caplog):
    jobs = made("ending", 4, tmp_path, end2="hang")
    with Cluster(tmp_path, [PLAIN]) as cluster:

        def kill():
            awaited(lambda: (tmp_path / "starts").exists() and starts(tmp_path, 3)[2])
            cluster.workers[0].kill()

        with gs.sweep.DaskExecutor(cluster.address, timeout=60) as executor:
            executor._patience = 3
            threading.Thread(target=kill).start()
            with pytest.raises(SweepLost, match="no worker has been there for 3 s"):
                swept(jobs, tmp_path / "t.csv", executor)
            assert "no worker is left, waiting 3 s for one" in caplog.text and executor.alive
            with pytest.raises(OSError, match="no worker has been there"):
                executor.submit(abs, 1).result(timeout=60)
        assert gs.sweep.read_table(tmp_path / "t.csv")["seed"] == [0, 1]


@pytest.mark.parametrize(
    ("number", "reason"),
    [
        (signal.SIGKILL, "has ended before the sweep"),
        pytest.param(signal.SIGSTOP, "the scheduler has not answered for 3 s", marks=pytest.mark.slow),
    ],
)
def test_a_lost_scheduler_leaves_finished_jobs(tmp_path, number, reason):
    jobs = made("slow", 8, tmp_path, seconds=0.02)
    with Cluster(tmp_path, [PLAIN]) as cluster:

        def kill(row):
            if row["seed"] == "2":
                cluster.scheduler.send_signal(number)

        with gs.sweep.DaskExecutor(cluster.address, timeout=60) as executor:
            assert executor.slots == 1 and executor.address == cluster.address
            executor._patience = 3
            with pytest.raises(SweepLost, match=reason):
                swept(jobs, tmp_path / "t.csv", executor, on_row=kill, window=2)
        cluster.scheduler.kill()
    finished = gs.sweep.read_table(tmp_path / "t.csv")["seed"]
    assert {0, 1, 2} <= set(finished) and len(finished) < 8
    (tmp_path / "runs").unlink()
    ended, table = swept(jobs, tmp_path / "t.csv", resume=True)
    again = [int(line) for line in (tmp_path / "runs").read_text().split()]
    assert sorted([*again, *finished]) == list(range(8)) == table["seed"] and ended.skipped == len(finished)


def security(ca, certificate, key):
    names = {f"tls_{role}_{part}": path for role in ("client", "scheduler", "worker")
             for part, path in (("cert", certificate), ("key", key))}  # fmt: skip
    return distributed.Security(tls_ca_file=ca, require_encryption=True, **names)


@pytest.mark.slow
def test_tls_keeps_others_out(tmp_path, capsys):
    own, foreign = (write_certificates(tmp_path / name) for name in ("own", "foreign"))
    tls = ("--tls-ca-file", own[0], "--tls-cert", own[1], "--tls-key", own[2])
    (tmp_path / "plan.yaml").write_text("options: {map: none.yaml, log: none.log}\naxes: {seed: 2}\n")
    with Cluster(tmp_path, [(*PLAIN, *tls)], scheduler=(*tls, "--protocol", "tls")) as cluster:
        assert cluster.address.startswith("tls://127.0.0.1:")
        with gs.sweep.DaskExecutor(cluster.address, security=security(*own), timeout=60) as executor:
            ended, _ = swept(made("plain", 2, tmp_path), tmp_path / "t.csv", executor)
            assert ended.done == 2
        for address, certificates in (
            (cluster.address, foreign),
            (cluster.address.replace("tls:", "tcp:"), None),
        ):
            with pytest.raises(OSError, match="must have a scheduler with workers"):
                gs.sweep.DaskExecutor(address, security=certificates and security(*certificates), timeout=2)
        call = ["sweep", str(tmp_path / "plan.yaml"), "--no-send", "--dask", cluster.address]
        files = ["--tls-ca", own[0], "--tls-cert", own[1], "--tls-key", own[2]]
        # The jobs fail for want of a map, but on the cluster.
        assert cli.main([*call, *files, "--table", str(tmp_path / "c.csv")]) == 1
        assert "2 FAILED" in capsys.readouterr().out and "none.log" in (tmp_path / "c.csv").read_text()
        more = ["--table", str(tmp_path / "d.csv")]
        assert "security: must have certificates for TLS, got none for tls://" in error_of([*call, *more], capsys)


def strictly_verified(ca, certificate):
    """Return whether OpenSSL accepts a certificate, by the rules of Python 3.13."""
    call = ["openssl", "verify", "-x509_strict", "-CAfile", ca, certificate]
    return subprocess.run(call, capture_output=True, check=False).returncode == 0


@pytest.mark.long
def test_certificates_of_the_page_are_valid(tmp_path):
    own, other = write_certificates(tmp_path / "own"), write_certificates(tmp_path / "other")
    assert strictly_verified(*own[:2]) and not strictly_verified(other[0], own[1])
    security(*own).get_connection_args("client")


@pytest.mark.long
def test_a_cluster_of_this_machine_may_use_tls(tmp_path):
    own = write_certificates(tmp_path)
    with gs.sweep.DaskExecutor(devices=["numpy"], security=security(*own)) as executor:
        assert executor.address.startswith("tls://127.0.0.1:")
        assert all(address.startswith("tls://127.0.0.1:") for address in executor._workers())
        assert executor.submit(abs, -3).result(timeout=60) == 3


@pytest.mark.long
def test_a_watch_that_fails_ends_the_calls():
    with gs.sweep.DaskExecutor(timeout=60) as executor:
        running = executor.submit(time.sleep, 600)
        queued = executor.submit(abs, 1)
        executor._usable = lambda workers: 1 / 0
        for future in (running, queued):
            with pytest.raises(OSError, match="the workers could not be followed: ZeroDivisionError"):
                future.result(timeout=60)
