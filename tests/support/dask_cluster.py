"""Dask clusters on the loopback in external processes."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import time
from pathlib import Path


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
            self._wait(lambda: file.exists() and file.read_text().endswith("}"))
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

    def _wait(self, ready):
        end = time.monotonic() + 60
        while not ready():
            assert self.scheduler.poll() is None and time.monotonic() < end, "the scheduler has not started"
            time.sleep(0.05)

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
