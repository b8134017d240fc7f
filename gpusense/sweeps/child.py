"""The process of a worker runs one call at a time; payloads and answers are pickles.

Only its supervisor, ``gpusense/sweeps/supervised.py``, reads the answers.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import multiprocessing.connection
import os
import pickle
import signal
import sys
import threading
import traceback
from multiprocessing.connection import Connection
from typing import Any

from gpusense._util.worker_device import DEVICE
from gpusense.sweeps.worker import error_text

# Messages before an answer: the process has started, and it has begun a call.
READY, BEGUN = b"ready", b"begun"
# The system ends workers before their supervisor when memory is short.
_EXPENDABLE = "500"
# Seconds between two checks for the parent, in addition to the notice of its end.
_LOOK = 5.0


def serve(link: Connection, device: str) -> None:
    """Run the calls that arrive over a link, until it closes.

    Args:
        link: Link to the supervisor.
        device: Selection string of the worker's device; empty leaves that of the environment.
    """
    _detach(link)
    if device:
        os.environ[DEVICE] = device
    link.send_bytes(READY)
    while True:
        try:
            payload = link.recv_bytes()
        except EOFError:
            return
        link.send_bytes(BEGUN)
        link.send_bytes(_answer(payload))


def _answer(payload: bytes) -> bytes:
    """Run a call, and return the pickle of its success and of its result or error."""
    try:
        function, args, kwargs = pickle.loads(payload)
        return pickle.dumps((True, function(*args, **kwargs)))
    except BaseException as error:
        # Any error belongs to the job: Ctrl-C is handled by the parent, and SystemExit must not end the process.
        return _failure(error)


def _failure(error: BaseException) -> bytes:
    """Return the pickle of an error; an error that cannot be unpickled becomes a RuntimeError."""
    with contextlib.suppress(Exception):
        error.add_note(f"in the worker:\n{''.join(traceback.format_exception(error))}")
        dumped = pickle.dumps((False, error))
        pickle.loads(dumped)
        return dumped
    return pickle.dumps((False, RuntimeError(error_text(error))))


def _detach(link: Connection) -> None:
    """Make the process end with its parent, but not by the parent's Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # A job may start further processes, which must not hold the link open.
    multiprocessing.current_process().daemon = False
    os.set_inheritable(link.fileno(), False)
    if sys.platform != "win32":
        # A new process group: processes that a job has started end with the worker.
        with contextlib.suppress(OSError):
            os.setsid()
        os.register_at_fork(after_in_child=link.close)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, [signal.SIGINT])
        with contextlib.suppress(OSError), open("/proc/self/oom_score_adj", "w") as file:
            file.write(_EXPENDABLE)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
        _end_in_kernel(parent.sentinel)


def _end_with(parent: Any) -> None:
    """Wait for the end of the parent, and end the process."""
    while not multiprocessing.connection.wait([parent.sentinel], _LOOK):
        if os.getppid() != parent.pid:
            break
    os._exit(1)


def _end_in_kernel(sentinel: int) -> None:
    """Let the system end the process with its parent, even in a job that never lets another thread run."""
    if sys.platform == "linux":
        import fcntl

        with contextlib.suppress(OSError):
            fcntl.fcntl(sentinel, fcntl.F_SETOWN, os.getpid())
            fcntl.fcntl(sentinel, fcntl.F_SETSIG, signal.SIGKILL)
            fcntl.fcntl(sentinel, fcntl.F_SETFL, fcntl.fcntl(sentinel, fcntl.F_GETFL) | os.O_ASYNC)
