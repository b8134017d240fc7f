"""Tasks of sweeps that end at once, fail, or end their worker; runs of sweeps, and waits for processes."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import gpusense as gs


def swept(jobs, path, executor=None, **options):
    """Run jobs with the NumPy backend; return the summary and the table."""
    ended = gs.sweep.run(jobs, table=path, executor=executor, backend="numpy", **options)
    return ended, gs.sweep.read_table(path)


def awaited(what, seconds=60):
    """Wait for a condition."""
    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end, "it has not come"
        time.sleep(0.02)


def alive(process):
    """Return whether a process runs; zombies do not."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def plain(job, store):
    """Return a number of the seed, and whether a model was made for this job."""
    reads = store.reads
    store.keep("numbers", job.map, lambda: job.map)
    return {"value": (job.seed + 1) / 3, "made": store.reads > reads, "process": os.getpid()}


def failing(job, store):
    """Fail for odd seeds."""
    if job.seed % 2:
        raise ValueError(f"a bad\nseed, {job.seed}")
    return plain(job, store)


def deadly(job, store):
    """Kill the worker at seed 3 once, recorded by a file, and at seed 4 always if the option is set."""
    done = Path(job.option("folder")) / "killed"
    if (job.seed == 3 and not done.exists()) or (job.seed == 4 and job.option("always")):
        done.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return plain(job, store)


def slow(job, store):
    """Append the seed to a file, and wait briefly."""
    with open(Path(job.option("folder")) / "runs", "a") as file:
        file.write(f"{job.seed}\n")
    time.sleep(job.option("seconds"))
    return {"value": job.seed * 0.1}


def ended_from_above(job, store):
    """Kill the Dask worker of the process in the first start of seed 1."""
    started(job)
    if job.seed == 1 and starts(job.option("folder"), 2)[1] == 1:
        os.kill(os.getppid(), signal.SIGKILL)
        time.sleep(600)
    return {"value": job.seed}


def started(job):
    """Record that a job has started."""
    with open(Path(job.option("folder")) / "starts", "a") as file:
        file.write(f"{job.seed}\n")


def starts(folder, count):
    """Return the number of starts of each of the first jobs."""
    lines = (Path(folder) / "starts").read_text().split()
    return [lines.count(str(seed)) for seed in range(count)]


def _fork():
    # The other process keeps all inherited files open.
    if os.fork():
        os._exit(9)
    time.sleep(600)


ENDS = {
    "segmentation fault": lambda: ctypes.string_at(0),
    "exit code 7": lambda: os._exit(7),
    "exit code 0": lambda: os._exit(0),
    "abort": os.abort,
    "kill": lambda: os.kill(os.getpid(), signal.SIGKILL),
    "terminate": lambda: os.kill(os.getpid(), signal.SIGTERM),
    "fork": _fork,
    "SystemExit": lambda: sys.exit("enough"),
    "KeyboardInterrupt": lambda: os.kill(os.getpid(), signal.SIGINT) or signal.raise_signal(signal.SIGINT) or raised(),
    "hang": lambda: time.sleep(600),
    "hang in C": lambda: pow(3, 1 << 31),
    "unreadable": lambda: threading.Lock(),
}


def raised():
    """Raise KeyboardInterrupt."""
    raise KeyboardInterrupt


def ending(job, store):
    """End by the seed's option, if set."""
    started(job)
    end = job.option(f"end{job.seed}")
    return {"value": ENDS[end]() if end else job.seed / 3}


def start_and_end(folder):
    """Start a process that outlasts the worker, and end the worker."""
    process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
    (Path(folder) / "process").write_text(str(process.pid))
    os._exit(3)


def sent_text(name):
    """Return the text of a sent file."""
    from gpusense.sweeps.process import SENT

    return Path(SENT[name]).read_text()
