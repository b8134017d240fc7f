"""Child processes for work with a driver: its crash or hang does not harm the user's process.

A driver may also end its process with exit status 0, so the status proves nothing: the child's last report must repeat
a number that it was sent.
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import glob
import importlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from typing import IO, Any

from gpusense._util.files import unnamed_file

# Default time limit [s]; a first compilation takes about 3 s on a common processor.
_LIMIT = 60.0
# A child that waits for a processor gets more time, at most this number of limits.
_MOST_LIMITS = 10
MARK = "gpusense-child "
# Bytes of a child's output that are searched for reports.
_MOST_OUTPUT = 16 << 20
_START = (
    "import sys, json; job = json.loads(sys.stdin.readline()); sys.path[:] = job['path']; "
    "from gpusense.backends.probe_process import main; main(job)"
)
# External signals, no failure of the driver.
_FOREIGN = tuple(getattr(signal, name) for name in ("SIGKILL", "SIGTERM", "SIGINT", "SIGHUP") if hasattr(signal, name))
# Failures due to the state of the machine, not to the driver.
PASSING = re.compile(
    r"No space left|is full|quota|Permission denied|Read-only file|[Oo]ut of memory|MemoryError|allocate|takes \d+ MiB"
)
# Lines of a dying process that do not name the cause.
_NOISE = re.compile(r"^(\s*$|Stack dump|PLEASE submit|\s*#?\d+[.\s]|\d+ warnings? generated|Aborted| +File |Traceback)")


@dataclass(frozen=True)
class Outcome:
    """The reports and the end of a child process."""

    said: list[dict[str, Any]]  # its reports, in order, without the last one
    failure: str = ""  # the failure in one line; empty where it ended well
    conclusive: bool = True  # false if something other than the driver may have ended it
    started: bool = True  # false if the system started no child


def is_off() -> bool:
    """Return whether ``$GPUSENSE_PROOF`` switches proofs off."""
    return os.environ.get("GPUSENSE_PROOF", "").lower() in ("off", "0", "false", "no")


def obstacle() -> str:
    """Return why this program starts no children: its executable is no interpreter; empty where it is one."""
    if getattr(sys, "frozen", False):
        return "a frozen program has no interpreter for a child process"
    if not re.match(r"(python|pypy)", os.path.basename(sys.executable or "").lower()):
        return f"{sys.executable or 'this program'} is no Python interpreter that a child process could run"
    return ""


def can_start() -> bool:
    """Return whether children are to be started: proofs are not switched off, and there is an interpreter."""
    return not is_off() and not obstacle()


def time_limit() -> float:
    """Return the time limit of a child [s]: ``$GPUSENSE_PROOF_SECONDS``."""
    text = os.environ.get("GPUSENSE_PROOF_SECONDS", "")
    try:
        seconds = float(text) if text else _LIMIT
    except ValueError:
        seconds = 0.0
    if not 0 < seconds < float("inf"):
        raise ValueError(f"GPUSENSE_PROOF_SECONDS: must be a number of seconds > 0, got {text!r}")
    return seconds


def run(job: dict[str, Any]) -> Outcome:
    """Do a job in a child.

    ``job``: ``do`` names a function ``module:name``; it is called with the job and a function that reports a
    dictionary; the rest belongs to the function.
    """
    path = [os.path.abspath(entry) for entry in sys.path]
    return run_text(["-P", "-W", "ignore", "-c", _START], {**job, "path": path})


def run_text(arguments: list[str], job: dict[str, Any], variables: dict[str, str] | None = None) -> Outcome:
    """Run the interpreter in a child with a job on standard input, one line of JSON with a ``token``.

    The child's last report must be ``{"done": token}``.
    """
    import secrets

    # The child must not start children.
    environment = os.environ | {"GPUSENSE_PROOF": "off"} | (variables or {})
    command = [sys.executable, *arguments]
    limit, token = time_limit(), secrets.token_hex(16)
    with contextlib.ExitStack() as stack:
        try:
            out, errors = (stack.enter_context(unnamed_file()) for _ in range(2))
            process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=out, stderr=errors, env=environment, start_new_session=True
            )
        except OSError as error:
            return Outcome([], f"no child process can be started: {error}", conclusive=False, started=False)
        starved = False
        try:
            with contextlib.suppress(BrokenPipeError):
                starved = _await(process, json.dumps({**job, "token": token}).encode() + b"\n", limit)
            code = process.returncode
        finally:
            _end(process)
        said = _read_reports(out)
        answered = said[-1:] == [{"done": token}]
        if answered:
            del said[-1]
        if code == 0:
            return Outcome(said, "" if answered else "ends the process with exit code 0, without an answer")
        if code is None:
            return Outcome(said, f"hangs: no answer in {limit:g} s", conclusive=not starved)
        failure = _describe(code, _last_words(errors))
        return Outcome(said, failure, conclusive=-code not in _FOREIGN and not PASSING.search(failure))


def _await(process: subprocess.Popen[bytes], text: bytes, limit: float) -> bool:
    """Wait for the end of a child, at most ``limit`` seconds in which it does not wait for a processor.

    Return True if it was ended before: a machine that busy gives no verdict on the driver.
    """
    begun, wait, unsent, left = time.monotonic(), limit, text, 0.0
    while wait > 0:
        try:
            process.communicate(unsent, timeout=wait)
            return False
        except subprocess.TimeoutExpired:
            unsent = b""
            elapsed = time.monotonic() - begun
            left = limit - elapsed + min(_starved(process.pid), elapsed)
            wait = min(left, _MOST_LIMITS * limit - elapsed)
    return left > 0


def _starved(process: int) -> float:
    """Return how long the threads of a process have waited for a processor [s]; 0 where the system does not say."""
    total = 0
    for file in glob.glob(f"/proc/{process}/task/*/schedstat"):
        with contextlib.suppress(OSError, ValueError, IndexError), open(file, encoding="ascii") as stream:
            total += int(stream.read().split()[1])
    return total / 1e9


def _end(process: subprocess.Popen[bytes]) -> None:
    """End the child, if it still runs, and the child's children."""
    if process.poll() is None:
        with contextlib.suppress(OSError):
            if hasattr(os, "killpg"):
                os.killpg(process.pid, signal.SIGKILL)
            else:
                process.kill()
        process.wait()


def _read_reports(file: IO[bytes]) -> list[dict[str, Any]]:
    """Return the reports in a child's output."""
    file.seek(0)
    lines = file.read(_MOST_OUTPUT).decode("utf-8", "replace").splitlines()
    reports = []
    for line in lines:
        _, mark, text = line.partition(MARK)
        if mark:
            # The last line of a child that was killed may be cut off.
            with contextlib.suppress(ValueError):
                reports.append(json.loads(text))
    return reports


def _last_words(file: IO[bytes]) -> str:
    """Return the line of standard error that best names the cause of a process's end."""
    size = file.seek(0, os.SEEK_END)
    file.seek(max(size - (1 << 16), 0))
    lines = file.read().decode("utf-8", "replace").splitlines()
    words = [line.strip() for line in lines if not _NOISE.match(line)]
    errors = [line for line in words if re.search(r"\berror\b", line, re.IGNORECASE)]
    return (errors or words or [""])[0 if errors else -1][:200]


def _describe(code: int, words: str) -> str:
    """Return the end of a process in one line."""
    if code >= 0:
        return words or f"exit code {code}"
    try:
        name = signal.Signals(-code).name
    except ValueError:
        name = f"signal {-code}"
    return f"ends the process with {name}" + (f" ({words})" if words else "")


def main(job: dict[str, Any]) -> None:
    """Do a job in this process, the child."""
    # At its end, Python would look for cycles among all objects of the libraries, which can take a second.
    atexit.register(gc.freeze)
    with contextlib.suppress(ImportError, ValueError, OSError):
        import resource

        # A process that is expected to die must not dump core.
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))

    def report(values: dict[str, Any]) -> None:
        sys.stdout.write(f"\n{MARK}{json.dumps(values)}\n")
        sys.stdout.flush()

    module, _, name = job["do"].partition(":")
    getattr(importlib.import_module(module), name)(job, report)
    report({"done": job["token"]})
