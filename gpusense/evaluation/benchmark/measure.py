"""Measure a candidate's cost: first call, building of its tables, steady calls, and the size of the tables."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from gpusense.backends import Backend

LONG = 1.0
"""Duration of a call above which it is not repeated [s]."""
SLOW_TO_MAKE = 2.0
"""Duration of a first call above which no second runner is made, so that building includes compiling [s]."""
FEWEST = 3
"""Least number of timed calls."""


class Runner(Protocol):
    """A candidate made for a scene; it may also have ``prepare(poses)``, ``ranges(poses)`` and ``table_bytes``."""

    def run(self, poses: np.ndarray) -> np.ndarray:
        """Compute (N, K) ranges or (N,) log-likelihoods of (N, 3) poses."""


@dataclass(frozen=True)
class Cost:
    """Measured times [s] and sizes [bytes]; None where a measurement is not possible.

    Attributes:
        first_s: Making the runner and its first call, compiling included.
        build_s: Time that a second runner, with compiled kernels, takes before its steady state: building the map's
            tables. Without a second runner, compiling is included.
        compile_s: First time minus second time: compiling, or loading kernels from a cache on disk. Kernels that this
            process compiled before add nothing. None without a second runner.
        call_min_s, call_q1_s, call_median_s, call_q3_s: A call with NumPy arrays in and out: least time and quartiles.
        processor_s: Processor time of a call, over all threads of the process: the mean of the timed calls.
        calls: Number of timed calls after a warm-up; 1 where a call takes more than a second.
        table_bytes: Tables of the map on the device.
    """

    first_s: float
    build_s: float
    compile_s: float | None
    call_min_s: float
    call_q1_s: float
    call_median_s: float
    call_q3_s: float
    processor_s: float
    calls: int
    table_bytes: int | None = None


class Made(NamedTuple):
    """A runner with built tables, and the times that they took [s]."""

    runner: Runner
    first_s: float
    build_s: float


def measure(
    make: Callable[[], Runner],
    backend: Backend | None,
    poses: np.ndarray,
    repeats: int,
    seconds: float = float("inf"),
    slow_to_make: float | None = None,
    made: Made | None = None,
) -> tuple[Cost, Made]:
    """Measure calls of (N, 3) poses, and return the runner with built tables; ``made`` replaces a new one.

    ``seconds``: Longest time of the timed calls, of which there are at least three [s]. ``slow_to_make``: Duration of a
    first call above which no second runner is made [s]; None: ``SLOW_TO_MAKE``.
    """
    compiling = None
    if made is None:
        begin = time.perf_counter()
        runner, built = _prepared(make, backend, poses)
        runner.run(poses)
        first = time.perf_counter() - begin
    else:
        runner, first, built = made
    used: list[float] = []
    calls = series(lambda: runner.run(poses), repeats, FEWEST, seconds, used)
    if made is None:
        second, limit = first, SLOW_TO_MAKE if slow_to_make is None else slow_to_make
        if min(calls) <= LONG and first - min(calls) < limit:
            # Free the first runner's memory before the second one is made.
            del runner
            begin = time.perf_counter()
            runner, built = _prepared(make, backend, poses)
            runner.run(poses)
            second = time.perf_counter() - begin
            compiling = max(first - second, 0.0)
        built = max(second - min(calls), 0.0) if built is None else built
    assert built is not None
    q1, median, q3 = (float(value) for value in np.quantile(calls, (0.25, 0.5, 0.75)))
    cost = Cost(
        first, built, compiling, min(calls), q1, median, q3, statistics.fmean(used), len(calls),
        getattr(runner, "table_bytes", None),
    )  # fmt: skip
    return cost, Made(runner, first, built)


def _prepared(make: Callable[[], Runner], backend: Backend | None, poses: np.ndarray) -> tuple[Runner, float | None]:
    """Make a runner; return it with the time to make it and its tables [s], or None if it has no ``prepare``."""
    begin = time.perf_counter()
    runner: Any = make()
    if not hasattr(runner, "prepare"):
        return runner, None
    runner.prepare(poses)
    if backend is not None:
        backend.synchronize()
    return runner, time.perf_counter() - begin


def series(
    run: Callable[[], object], repeats: int, fewest: int = 1, seconds: float = float("inf"),
    used: list[float] | None = None,
) -> list[float]:  # fmt: skip
    """Time calls after one warm-up; return their seconds, or the warm-up's if it takes more than ``LONG``.

    ``seconds``: Total time after which no call beyond ``fewest`` begins. ``used`` receives the processor's seconds of
    each call.
    """
    used = [] if used is None else used
    warm = _seconds(run, used)
    if warm > LONG:
        return [warm]
    used.clear()
    times: list[float] = []
    while len(times) < repeats and (len(times) < fewest or sum(times) < seconds):
        times.append(_seconds(run, used))
    return times


def _seconds(run: Callable[[], object], used: list[float]) -> float:
    begin, before = time.perf_counter(), time.process_time()
    run()
    used.append(time.process_time() - before)
    return time.perf_counter() - begin
