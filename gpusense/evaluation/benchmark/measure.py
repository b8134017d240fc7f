"""Measure a point's cost: first call, building, steady calls, launches alone, transfers, and memory on the device."""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from gpusense.backends import Backend
from gpusense.backends.base import Buffer, Launcher
from gpusense.backends.proxy import Proxy

LONG = 1.0
"""Duration of a call above which it is not repeated, nor its launches measured alone [s]."""
SLOW_TO_MAKE = 2.0
"""Duration of a first call above which no second runner is made, so that building includes compiling [s]."""
# Time to repeat launches alone for [s]; on a processor they take as long as calls.
_LAUNCH_SECONDS, FEWEST = {"gpu": 1.0, "cpu": 0.1}, 3


class Runner(Protocol):
    """A candidate made for a scene; it may also have ``prepare(poses)``, ``ranges(poses)`` and ``table_bytes``."""

    def run(self, poses: np.ndarray) -> np.ndarray:
        """Compute (N, K) ranges or (N,) log-likelihoods of (N, 3) poses."""


# Reference count of an object that only a list holds; it depends on the version of Python.
_LIST = [object()]
_ALONE = sys.getrefcount(_LIST[0])


class Meter(Proxy):
    """A backend that forwards every call to another backend, counts bytes, sums seconds and records launches.

    Pass it to a model as ``backend=``. Seconds and launches are recorded between :meth:`begin` and :meth:`end` only.
    """

    def __init__(self, backend: Backend) -> None:
        super().__init__(backend)
        self._held: list[Any] = []
        self._bytes: list[int] = []
        self.peak = 0
        self._on = False
        self.seconds = {"upload": 0.0, "launch": 0.0, "download": 0.0}
        self.launches: list[Callable[[], None]] = []

    @property
    def live(self) -> int:
        """Return the number of bytes of all live buffers."""
        # A buffer that only this list holds is free; drivers' buffers do not support weak references.
        kept = [i for i in range(len(self._held)) if sys.getrefcount(self._held[i]) > _ALONE]
        self._held, self._bytes = [self._held[i] for i in kept], [self._bytes[i] for i in kept]
        return sum(self._bytes)

    def upload(self, array: np.ndarray, out: Buffer | None = None, *, wait: bool = True) -> Buffer:
        if out is None:
            self._room(array.nbytes)
        begin = time.perf_counter()
        buffer = self._backend.upload(array, out, wait=wait)
        if self._on:
            self._backend.synchronize()
            self.seconds["upload"] += time.perf_counter() - begin
        if out is None:
            self._held.append(buffer)
            self._bytes.append(array.nbytes)
        return buffer

    def empty(self, count: int, dtype: np.dtype, *, zero: bool = False) -> Buffer:
        size = count * np.dtype(dtype).itemsize
        self._room(size)
        buffer = self._backend.empty(count, dtype, zero=zero)
        self._held.append(buffer)
        self._bytes.append(size)
        return buffer

    def download(self, buffer: Buffer, out: np.ndarray, *, wait: bool = True) -> np.ndarray:
        """See Backend.download; while the meter measures, this method always waits."""
        if not self._on:
            return self._backend.download(buffer, out, wait=wait)
        begin = time.perf_counter()
        self._backend.synchronize()
        arrived = time.perf_counter()
        result = self._backend.download(buffer, out)
        self.seconds["launch"] += arrived - begin
        self.seconds["download"] += time.perf_counter() - arrived
        return result

    def compile(self, kernel: str, flags: frozenset[str]) -> Launcher:
        launcher = self._backend.compile(kernel, flags)
        if not self._on:
            return launcher

        def launch(size: tuple[int, ...], *arguments: Any) -> None:
            begin = time.perf_counter()
            launcher(size, *arguments)
            self.seconds["launch"] += time.perf_counter() - begin
            self.launches.append(lambda: launcher(size, *arguments))

        return launch

    def synchronize(self) -> None:
        begin = time.perf_counter()
        self._backend.synchronize()
        if self._on:
            self.seconds["launch"] += time.perf_counter() - begin

    @property
    def in_batch(self) -> bool:
        """See Backend.in_batch; False while the meter measures, so that it sees every copy and launch."""
        return not self._on and super().in_batch

    def begin(self) -> None:
        """Start to record seconds and launches."""
        self._on = True

    def end(self) -> None:
        """Stop recording."""
        self._on = False

    def _room(self, size: int) -> None:
        """Release unused buffers before an allocation, as without this meter, and update the peak."""
        self.peak = max(self.peak, self.live + size)


@dataclass(frozen=True)
class Cost:
    """Measured times [s] and sizes [bytes]; None where a measurement is not possible.

    Attributes:
        first_s: Making the runner and its first call, compiling included.
        build_s: Time that a second runner, with compiled kernels, takes before its steady state: building the map's
            tables. If the first took more than ``slow_to_make`` of ``measure`` there is no second one, and compiling is
            included. A runner of an earlier cloud keeps its times.
        compile_s: First time minus second time: compiling, or loading kernels from a cache on disk. Kernels that this
            process compiled before add nothing. None without a second runner.
        call_min_s, call_q1_s, call_median_s, call_q3_s: A call with NumPy arrays in and out: least time and quartiles.
        processor_s: Processor time of a call, over all threads of the process: the mean of the timed calls.
        calls: Number of timed calls after a warm-up; 1 where a call takes more than a second.
        launch_min_s, launch_q1_s, launch_median_s, launch_q3_s: Launches of a call alone, arrays on the device.
        launches: Number of timed repetitions of the launches; 0 for a candidate without a backend.
        upload_s, download_s: Transfers of one call.
        table_bytes: Tables of the map on the device.
        device_bytes: All buffers that are alive after a call.
        peak_bytes: Largest size of all buffers alive at a time.
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
    launch_min_s: float | None = None
    launch_q1_s: float | None = None
    launch_median_s: float | None = None
    launch_q3_s: float | None = None
    launches: int = 0
    upload_s: float | None = None
    download_s: float | None = None
    table_bytes: int | None = None
    device_bytes: int | None = None
    peak_bytes: int | None = None


class Earlier(NamedTuple):
    """A runner of an earlier cloud of the scene, with its times."""

    meter: Meter | None
    runner: Runner
    first_s: float
    build_s: float


def measure(
    make: Callable[[Any], Runner],
    backend: Backend | None,
    poses: np.ndarray,
    repeats: int,
    seconds: float = float("inf"),
    slow_to_make: float | None = None,
    earlier: list[Earlier] | None = None,
) -> tuple[Cost, Runner]:
    """Measure a candidate, and return its runner with built tables.

    ``backend``: The device; None for a candidate without a backend. ``poses``: (N, 3) particles of a call. ``seconds``:
    Longest time of the timed calls, of which there are at least three, and of the launches alone [s]. ``slow_to_make``:
    Duration of a first call above which no second runner is made [s]; None: ``SLOW_TO_MAKE``. ``earlier``: A runner of
    another cloud, if there is one, is measured instead of a new one. Otherwise it receives a runner that took longer
    than ``slow_to_make``. None: each cloud gets new runners.
    """
    limit = SLOW_TO_MAKE if slow_to_make is None else slow_to_make
    meter = None if backend is None else Meter(backend)
    begin = time.perf_counter()
    built: float | None
    if earlier:
        meter, runner, first, built = earlier[0]
        runner.run(poses)
    else:
        runner, built = _prepared(make, meter, poses)
        runner.run(poses)
        first = time.perf_counter() - begin
    used: list[float] = []
    calls = series(lambda: runner.run(poses), repeats, FEWEST, seconds, used)
    on_device: dict[str, Any] = {}
    quick = min(calls) <= LONG
    if meter is not None:
        on_device = {"device_bytes": meter.live, "peak_bytes": meter.peak}
        on_device |= _apart(meter, runner, poses, repeats, seconds) if quick else {}
        meter.launches.clear()
    table = getattr(runner, "table_bytes", None)
    compiling = None
    if quick and first - min(calls) < limit:
        # Free the first runner's memory before the second one is made.
        del runner, meter
        begin = time.perf_counter()
        runner, built = _prepared(make, backend, poses)
        runner.run(poses)
        second = time.perf_counter() - begin
        compiling = max(first - second, 0.0)
        built = max(second - min(calls), 0.0) if built is None else built
    else:
        built = first - min(calls) if built is None else built
        if earlier is not None and not earlier:
            earlier.append(Earlier(meter, runner, first, built))
    on_device |= quartiles("call", calls)
    cost = Cost(
        first_s=first, build_s=built, compile_s=compiling, processor_s=statistics.fmean(used), calls=len(calls),
        table_bytes=table, **on_device,
    )  # fmt: skip
    return cost, runner


def quartiles(name: str, seconds: Sequence[float]) -> dict[str, float]:
    """Return the least and the quartiles of times, by the names of a :class:`Cost`."""
    q1, median, q3 = (float(value) for value in np.quantile(seconds, (0.25, 0.5, 0.75)))
    return {f"{name}_min_s": min(seconds), f"{name}_q1_s": q1, f"{name}_median_s": median, f"{name}_q3_s": q3}


def _prepared(make: Callable[[Any], Runner], backend: Any, poses: np.ndarray) -> tuple[Runner, float | None]:
    """Make a runner; return it with the time to make it and its tables [s], or None if it has no ``prepare``."""
    begin = time.perf_counter()
    runner = make(backend)
    prepare = getattr(runner, "prepare", None)
    if prepare is None:
        return runner, None
    prepare(poses)
    if backend is not None:
        backend.synchronize()
    return runner, time.perf_counter() - begin


def series(
    run: Callable[[], object],
    repeats: int,
    fewest: int = 1,
    seconds: float = float("inf"),
    used: list[float] | None = None,
) -> list[float]:
    """Time calls after one warm-up; return their seconds, or the warm-up's if it takes more than ``LONG``."""
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


def _apart(meter: Meter, runner: Runner, poses: np.ndarray, repeats: int, seconds: float) -> dict[str, Any]:
    """Time the transfers of one call, and its launches alone with all arrays on the device."""
    meter.begin()
    runner.run(poses)
    meter.end()
    launches, backend = meter.launches, meter._backend

    def launch() -> None:
        for replay in launches:
            replay()
        backend.synchronize()

    times: dict[str, Any] = {"upload_s": meter.seconds["upload"], "download_s": meter.seconds["download"]}
    if launches:
        each = series(launch, repeats, FEWEST, min(_LAUNCH_SECONDS[backend.info.kind], seconds))
        times |= {**quartiles("launch", each), "launches": len(each)}
    return times
