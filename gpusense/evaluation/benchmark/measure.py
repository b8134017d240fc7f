"""What a point costs: first call, building, steady calls, launches alone, transfers, and memory on the device."""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from gpusense.backends import Backend
from gpusense.backends.base import Buffer, Launcher, Proxy

LONG = 2.0
"""A single call of more seconds is not repeated."""
SLOW_TO_MAKE = 2.0
"""What takes more seconds to make is made once: its compiling and building are then told apart by no second one."""
# Launches alone are repeated until so many seconds are over: on a processor they take as long as calls.
_LAUNCH_SECONDS, _FEWEST_LAUNCHES = {"gpu": 1.0, "cpu": 0.1}, 3


class Runner(Protocol):
    """A candidate made for a scene; it may also have ``prepare(poses)``, ``ranges(poses)`` and ``table_bytes``."""

    def run(self, poses: np.ndarray) -> np.ndarray:
        """(N, K) ranges or (N,) log-likelihoods of (N, 3) poses."""


# What getrefcount says of an object that only a list holds: versions of Python differ.
_LIST = [object()]
_ALONE = sys.getrefcount(_LIST[0])


class Meter(Proxy):
    """A backend that passes everything on, and on the way counts bytes, sums seconds and remembers launches.

    Give it to a model as ``backend=``. Seconds and launches are taken between :meth:`begin` and :meth:`end` only.
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
        """Bytes of the buffers that are alive."""
        # A buffer that only this list still holds has been let go of; drivers' buffers take no weak references.
        kept = [i for i in range(len(self._held)) if sys.getrefcount(self._held[i]) > _ALONE]
        self._held, self._bytes = [self._held[i] for i in kept], [self._bytes[i] for i in kept]
        return sum(self._bytes)

    def upload(self, array: np.ndarray, out: Buffer | None = None, *, wait: bool = True) -> Buffer:
        """See Backend.upload."""
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
        """See Backend.empty."""
        size = count * np.dtype(dtype).itemsize
        self._room(size)
        buffer = self._backend.empty(count, dtype, zero=zero)
        self._held.append(buffer)
        self._bytes.append(size)
        return buffer

    def download(self, buffer: Buffer, out: np.ndarray, *, wait: bool = True) -> np.ndarray:
        """See Backend.download; while it measures, this one always waits."""
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
        """See Backend.compile."""
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
        """See Backend.synchronize."""
        begin = time.perf_counter()
        self._backend.synchronize()
        if self._on:
            self.seconds["launch"] += time.perf_counter() - begin

    @property
    def gathers(self) -> bool:
        """See Backend.gathers; while it measures, every copy and launch is seen by itself."""
        return not self._on and super().gathers

    def begin(self) -> None:
        """Take seconds and launches from now on."""
        self._on = True

    def end(self) -> None:
        """Take no more."""
        self._on = False

    def _room(self, size: int) -> None:
        """Let go of what nobody else holds before something new is made, as without this meter."""
        self.peak = max(self.peak, self.live + size)


@dataclass(frozen=True)
class Cost:
    """What was measured, in seconds and bytes; None where it could not be.

    Attributes:
        first_s: Making the candidate and its first call, with compiling.
        build_s: What a second one, compiled already, takes before its steady state: the tables of the map. Where the
            first took more than ``SLOW_TO_MAKE`` seconds there is no second, and compiling is in here.
        compile_s: How much longer the first took than the second: compiling, or loading kernels from a cache on disk.
            Kernels that this process has compiled already cost nothing here. None without a second.
        call_min_s, call_median_s: A call with NumPy arrays in and out.
        calls: How many were measured, after a warm-up; 1 where a call takes more than two seconds.
        launch_min_s, launch_median_s: Its launches alone, everything on the device.
        launches: How many times they were measured; 0 for what does not run on a backend.
        upload_s, download_s: Transfers of one call.
        table_bytes: Tables of the map on the device.
        device_bytes: All buffers that are alive after a call.
        peak_bytes: The most that were alive at a time.
    """

    first_s: float
    build_s: float
    compile_s: float | None
    call_min_s: float
    call_median_s: float
    calls: int
    launch_min_s: float | None = None
    launch_median_s: float | None = None
    launches: int = 0
    upload_s: float | None = None
    download_s: float | None = None
    table_bytes: int | None = None
    device_bytes: int | None = None
    peak_bytes: int | None = None


def measure(
    make: Callable[[Any], Runner], backend: Backend | None, poses: np.ndarray, repeats: int
) -> tuple[Cost, Runner]:
    """Measure a candidate, and return it with its tables made.

    Args:
        make: Makes it for a backend.
        backend: The device; None for what does not run on a backend.
        poses: (N, 3) particles of a call.
        repeats: How many calls are timed.
    """
    meter = None if backend is None else Meter(backend)
    begin = time.perf_counter()
    runner, built = _prepared(make, meter, poses)
    runner.run(poses)
    first = time.perf_counter() - begin
    calls = series(lambda: runner.run(poses), repeats)
    found: dict[str, Any] = {}
    if meter is not None:
        found = {"device_bytes": meter.live, "peak_bytes": meter.peak, **_apart(meter, runner, poses, repeats)}
        meter.launches.clear()
    table = getattr(runner, "table_bytes", None)
    compiling = None
    if first - min(calls) < SLOW_TO_MAKE:
        # Its memory is given back before the second one is made.
        del runner, meter
        begin = time.perf_counter()
        runner, built = _prepared(make, backend, poses)
        runner.run(poses)
        second = time.perf_counter() - begin
        compiling = max(first - second, 0.0)
        built = max(second - min(calls), 0.0) if built is None else built
    elif built is None:
        built = first - min(calls)
    cost = Cost(
        first_s=first, build_s=built, compile_s=compiling, call_min_s=min(calls),
        call_median_s=statistics.median(calls), calls=len(calls), table_bytes=table, **found,
    )  # fmt: skip
    return cost, runner


def _prepared(make: Callable[[Any], Runner], backend: Any, poses: np.ndarray) -> tuple[Runner, float | None]:
    """A candidate, and how long making it and its tables took, if it can make them apart from a call."""
    begin = time.perf_counter()
    runner = make(backend)
    prepare = getattr(runner, "prepare", None)
    if prepare is None:
        return runner, None
    prepare(poses)
    if backend is not None:
        backend.synchronize()
    return runner, time.perf_counter() - begin


def series(run: Callable[[], object], repeats: int, fewest: int = 1, seconds: float = float("inf")) -> list[float]:
    """Seconds of each call after one warm-up; the warm-up itself if it takes more than ``LONG`` seconds.

    Args:
        run: What is timed.
        repeats: How often.
        fewest: How often in any case.
        seconds: No more than ``fewest`` once so much time is over.
    """
    warm = _seconds(run)
    if warm > LONG:
        return [warm]
    times: list[float] = []
    while len(times) < repeats and (len(times) < fewest or sum(times) < seconds):
        times.append(_seconds(run))
    return times


def _seconds(run: Callable[[], object]) -> float:
    begin = time.perf_counter()
    run()
    return time.perf_counter() - begin


def _apart(meter: Meter, runner: Runner, poses: np.ndarray, repeats: int) -> dict[str, Any]:
    """Transfers of one call, and its launches alone with everything left on the device."""
    meter.begin()
    runner.run(poses)
    meter.end()
    launches, backend = meter.launches, meter._backend

    def launch() -> None:
        for again in launches:
            again()
        backend.synchronize()

    found: dict[str, Any] = {"upload_s": meter.seconds["upload"], "download_s": meter.seconds["download"]}
    if launches:
        times = series(launch, repeats, _FEWEST_LAUNCHES, _LAUNCH_SECONDS[backend.info.kind])
        found |= {"launch_min_s": min(times), "launch_median_s": statistics.median(times), "launches": len(times)}
    return found
