"""Run the jobs of a study on several processes, each with one thread of a processor device."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import Any

# PoCL reads the first of these up to version 5, the second one since then.
_ONE_THREAD = ("POCL_MAX_PTHREAD_COUNT", "POCL_CPU_MAX_CU_COUNT")


def results(function: Callable[..., Any], jobs: Sequence[tuple[Any, ...]], processes: int = 1) -> Iterator[Any]:
    """Return ``function(*job)`` of each job, in their order.

    Args:
        function: A function of a module, for one process and for several.
        jobs: Its arguments, plain data.
        processes: Number of processes; 1 runs the jobs here, with all threads.
    """
    if processes == 1:
        yield from (function(*job) for job in jobs)
        return
    for name in _ONE_THREAD:
        os.environ.setdefault(name, "1")
    # Devices do not survive a fork.
    with ProcessPoolExecutor(processes, mp_context=multiprocessing.get_context("spawn")) as pool:
        waiting = [pool.submit(function, *job) for job in jobs]
        yield from (one.result() for one in waiting)
