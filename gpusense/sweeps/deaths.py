"""Exceptions for the ways in which workers of a sweep end."""

from __future__ import annotations

import signal
from concurrent.futures import BrokenExecutor


class WorkerDied(BrokenExecutor):
    """A worker ended while it ran a job.

    Args:
        how: Way in which it ended, such as "by SIGSEGV" or "with exit code 3".
        memory: Largest memory observed during the job [bytes]; 0 if unknown.
        outside: Whether the cause may lie outside the job: a signal of another process, or the loss of a machine.

    Example:
        >>> import gpusense as gs
        >>> print(gs.sweep.WorkerDied("by SIGSEGV"))
        the worker ended by SIGSEGV
    """

    def __init__(self, how: str = "for an unknown reason", memory: int = 0, outside: bool = False) -> None:
        super().__init__(how, memory, outside)
        self.how, self.memory, self.outside = how, memory, outside

    def __str__(self) -> str:
        return f"the worker ended {self.how}"


class JobTimeout(WorkerDied):
    """A job ran for longer than its limit, and its worker was ended.

    Example:
        >>> import gpusense as gs
        >>> print(gs.sweep.JobTimeout("after the limit of 60 s"))
        the worker was ended after the limit of 60 s
    """

    def __str__(self) -> str:
        return f"the worker was ended {self.how}"


def death(code: int | None, memory: int, short: bool) -> WorkerDied:
    """Return the exception for a process that ended with an exit code."""
    if code is None:
        return WorkerDied(memory=memory, outside=True)
    if code >= 0:
        return WorkerDied(f"with exit code {code if code < 1 << 16 else hex(code)}", memory)
    try:
        name = signal.Signals(-code).name
    except ValueError:
        name = f"signal {-code}"
    if name != "SIGKILL":
        return WorkerDied(f"by {name}", memory)
    return WorkerDied(f"by {name}{', as the system ran out of memory' if short else ''}", memory, outside=True)
