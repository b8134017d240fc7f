"""Run jobs on a worker, independent of the executor that started it."""

from __future__ import annotations

import os
import platform
import threading
import time
import traceback
from collections.abc import Mapping
from typing import Any, NamedTuple

from gpusense.sweeps.job import Job
from gpusense.sweeps.store import Store
from gpusense.sweeps.tasks import task_of

# Environment variable with the selection string of a worker's device.
DEVICE = "GPUSENSE_SWEEP_DEVICE"
# Longest text of an error.
_LONGEST = 400


class Outcome(NamedTuple):
    """The result of a job."""

    values: dict[str, Any]  # columns of its row by name; empty after a failure
    error: str  # the error in one line; empty after success
    trace: str  # traceback of the error, for a log
    seconds: float  # time of the job [s]
    cpu_seconds: float  # processor time of the worker's process during the job [s]
    worker: str  # host and process of the worker
    device: str  # selection string of the device


# A worker runs one job at a time, since device and store serve only one.
_LOCK = threading.Lock()
# Stores by root, device and sweep, since files may change between sweeps.
_STORES: dict[tuple[str, str, str], Store] = {}
_SENT: dict[str, Any] = {}


def receive(sent: Mapping[str, Any]) -> None:
    """Keep the sent maps and logs for all jobs of this process."""
    with _LOCK:
        _SENT.update(sent)
        _STORES.clear()


def work(job: Job, root: str, device: str, sweep: str = "") -> Outcome:
    """Run a job in this process; errors are part of the result.

    ``device`` is for a worker without a chosen device. Files that were read for another sweep are read again.
    """
    chosen = os.environ.get(DEVICE) or device
    with _LOCK:
        begin, begin_cpu = time.perf_counter(), time.process_time()
        key = (root, chosen, sweep)
        if key not in _STORES:
            _STORES.clear()
            _STORES[key] = Store(root, chosen)
            _STORES[key].receive(_SENT)
        values: dict[str, Any] = {}
        error = trace = ""
        try:
            values = {name: _plain(value) for name, value in task_of(job)(job, _STORES[key]).items()}
        except KeyboardInterrupt:
            # In this process the interrupt is the user's, and ends the sweep.
            raise
        except BaseException as problem:
            # SystemExit is also an error of the job, and does not end the worker.
            error, trace = error_text(problem), traceback.format_exc()
        seconds, cpu = time.perf_counter() - begin, time.process_time() - begin_cpu
    return Outcome(values, error, trace, seconds, cpu, f"{platform.node()}:{os.getpid()}", chosen)


def error_text(error: BaseException) -> str:
    """Format an error for a row, on one line."""
    try:
        text = f"{type(error).__name__}: {error}"
    except Exception:
        text = f"{type(error).__name__} without a text"
    return " ".join(text.split())[:_LONGEST]


def _plain(value: Any) -> Any:
    """Convert NumPy's numbers to Python's."""
    return value.item() if hasattr(value, "item") else value
