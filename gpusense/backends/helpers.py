"""Threads that share the host's part of large work: launches on the processor, copies, and bounds of poses.

NumPy and Warp release Python's lock while they work on large arrays, so the threads run in parallel.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from concurrent.futures import Future, ThreadPoolExecutor

# Prefix of the names of the threads. They never wait for a device.
HELPERS = "gpusense pieces"


@functools.cache
def threads() -> int:
    """Return the number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@functools.cache
def pool(process: int) -> ThreadPoolExecutor:
    """Return the threads of a process, one fewer than it has processors: the calling thread also works."""
    # Calls of few particles, and most processes, need no threads.
    from concurrent.futures import ThreadPoolExecutor

    return ThreadPoolExecutor(max(threads() - 1, 1), HELPERS)


def finish(helpers: Sequence[Future[Any]]) -> None:
    """Cancel helpers that have not begun, and wait for running helpers even when interrupted."""
    if not helpers:
        return
    from concurrent.futures import wait

    interrupted: BaseException | None = None
    for helper in helpers:
        helper.cancel()
    while any(not helper.done() for helper in helpers):
        try:
            wait(helpers)
        except KeyboardInterrupt as error:
            interrupted = error
    if interrupted is not None:
        raise interrupted
