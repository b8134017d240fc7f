"""Measure calls of few particles beside their kernels, and several scans or models in one call; compare all bits.

    python bench/speed/small_calls.py --backend opencl
    python bench/speed/small_calls.py --backend warp:cuda:0 --rows calls bound --output bench/results/small_calls_name
    python bench/speed/small_calls.py --backend warp:cpu --rows scans models --particles 500 --particles 8000

Ways to the same result take turns in one run, so that their ratio is valid on a busy machine; their bits must be equal.
Times are of whole calls: NumPy arrays in and out, and on GPUs also arrays of Warp or pyopencl. Rows:

- *calls* of ``log_likelihood``, beside the plain way: copies by commands, and each launch started alone. "Kernels" are
    the launches of an ordinary call one after the other, with everything on the device.
- *bound* calls (``bind``) beside ``log_likelihood`` with the same arrays, with a wait after each call and after many:
  with NumPy arrays (on GPUs recorded launches with the copies, on CUDA as one graph; on processors the ordinary call),
  and on the device.
- *scans*: one call of several scans in shared launches, one call whose scans are queued one after the other, and a call
    for each scan. The library shares launches up to a number of particle-beams of a scan
    (``gpusense.models.scan.pipeline.TOGETHER``), and queues scans beyond it.
- *models*: several models in one call, and a call for each.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import functools
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.models.scan import pipeline

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import (
    MODELS,
    Recorder,
    Scene,
    Way,
    add_scene,
    best,
    differing_bits,
    in_turns,
    make_parser,
    note,
    on_device,
    on_host,
    one_by_one,
    parse,
    publish,
    table,
    table_line,
    waited,
)

ROWS = ("calls", "bound", "scans", "models")
# Calls of a turn.
TURN = 20
# Calls whose results are compared.
CHECKED = 5
# Spread of the clouds [m, rad].
SPREAD = (0.1, 0.1)
ALWAYS, NEVER = 1 << 62, 0
CALL_COLUMNS = (
    "backend", "device", "what", "ms a call (90 %, least)", "plain, ms", "ratio", "kernels, ms", "differing bits",
)  # fmt: skip
SEVERAL_COLUMNS = (
    "backend", "what", "together, ms", "queued, ms", "calls, ms", "together / calls", "queued / calls", "way",
    "differing bits",
)  # fmt: skip


@contextlib.contextmanager
def plainly(device: Any) -> Iterator[None]:
    """Make a backend work the plain way: without recorded launches and memory that host and device share."""
    before, shared = device.info, getattr(device, "_shared", None)
    device.info = dataclasses.replace(before, graphs=False)
    if shared is not None:
        device._shared = False
    try:
        yield
    finally:
        device.info = before
        if shared is not None:
            device._shared = shared


@contextlib.contextmanager
def sharing(limit: int) -> Iterator[None]:
    """Let scans of up to a number of particle-beams share launches."""
    before = pipeline.TOGETHER
    pipeline.TOGETHER = dict.fromkeys(before, limit)
    try:
        yield
    finally:
        pipeline.TOGETHER = before


class Bench:
    """Measures one device."""

    def __init__(self, selection: str, arguments: argparse.Namespace) -> None:
        self.device, self.arguments = get_backend(selection), arguments
        self.scene = Scene(arguments)
        self.gpu = self.device.info.kind == "gpu"
        self.calls: list[dict[str, Any]] = []
        self.several: list[dict[str, Any]] = []

    def run(self) -> None:
        """Measure all rows."""
        rows = set(self.arguments.rows)
        for beams in self.arguments.beams:
            scanner = self.scene.scanner(beams)
            scans = np.stack([self.scene.noisy_scan(scanner, self.device) for _ in range(self.arguments.scans)])
            for name, kind in reversed(MODELS.items()):
                make = functools.partial(kind, self.scene.grid, scanner)
                if rows & {"calls", "bound"}:
                    self.run_calls(f"{name}, ", make, scans)
                if rows & {"scans", "models"}:
                    self.run_several(f"{name}, ", make, scans)

    # ---- one scan a call

    def run_calls(self, name: str, make: Callable[..., Any], scans: np.ndarray) -> None:
        """Measure ordinary and bound calls of a model."""
        counts = self.arguments.particles or [2000, 4000]
        clouds = [self.scene.cloud("tracking", count, SPREAD).astype(np.float64) for count in counts]
        model = make(backend=self.device)
        with plainly(self.device):
            # This call allocates large enough buffers.
            plain = make(backend=self.device)
            plain._short = None
            plain.log_likelihood(max(clouds, key=len), scans[0])
        for poses in clouds:
            kernels, what = self.kernels(make, poses, scans[0]), f"{name}{len(poses)} x {scans.shape[1]}"
            if "calls" in self.arguments.rows:
                for label, count in (("", 1), (", another scan each time", len(scans))):
                    self.ordinary(what, label, (model, plain), poses, scans[:count], kernels)
            if "bound" in self.arguments.rows:
                self.bound(f"{what}, bound", model, poses, scans[0], kernels, np.array)
                if self.gpu:
                    there = functools.partial(on_device, self.device)
                    self.bound(f"{what}, bound, on the device", model, poses, scans[0], kernels, there)
                    self.bound(f"{what}, bound, poses on the device", model, poses, scans[0], kernels, there, np.array)

    def kernels(self, make: Callable[..., Any], poses: np.ndarray, scan: np.ndarray) -> float:
        """Return the median seconds of the launches of a call."""
        recorder = Recorder(self.device)
        model = make(backend=recorder)
        model.log_likelihood(poses, scan)
        launches = recorder.launches_of(lambda: model.log_likelihood(poses, scan))
        return best(waited(self.device, one_by_one(launches)), self.arguments.calls, np.inf)[1]

    def ordinary(
        self, what: str, label: str, models: tuple[Any, Any], poses: np.ndarray, scans: np.ndarray, kernels: float
    ) -> None:
        """Add rows of ordinary calls with one scan, or with several in turn."""
        (model, plain), count = models, self.arguments.calls

        def call(number: int, one: Any = model, poses: Any = poses, out: Any = None) -> Any:
            return one.log_likelihood(poses, scans[number % len(scans)], out=out)

        def ways(short: Callable[[int], Any], other: Callable[[int], Any]) -> tuple[Way, Way]:
            return Way(short), Way(other, functools.partial(plainly, self.device))

        self.add(f"{what}, NumPy in and out{label}", ways(call, functools.partial(call, one=plain)), kernels, count)
        if self.gpu:
            there = on_device(self.device, poses)
            out = on_device(self.device, np.zeros(len(poses), np.float32))
            into, anew = functools.partial(call, poses=there, out=out), functools.partial(call, poses=there)
            ranges = [on_device(self.device, scan) for scan in scans]

            def both(number: int) -> Any:
                return model.log_likelihood(there, ranges[number % len(ranges)])

            rows = {"on the device, out=": (into, into), "poses on the device": (anew, anew)}
            for words, (short, long) in (rows | {"poses and ranges on the device": (both, anew)}).items():
                self.add(f"{what}, {words}{label}", ways(short, functools.partial(long, one=plain)), kernels, count)

    def bound(
        self, what: str, model: Any, poses: np.ndarray, scan: np.ndarray, kernels: float,
        there: Callable[[np.ndarray], Any], ranges_there: Callable[[np.ndarray], Any] | None = None,
    ) -> None:  # fmt: skip
        """Add rows of a bound call against an ordinary one with the same arrays and readings on the host."""
        result = np.zeros(len(poses), np.float32)
        placed, out, other = there(poses), there(result), there(result)
        call = model.bind(placed, (ranges_there or there)(scan), out=out)

        def repeated(_: int, count: int) -> Any:
            for _ in range(count):
                call()
            call.check()
            return call.out

        def ordinary(_: int, count: int) -> Any:
            for _ in range(count):
                model.log_likelihood(placed, scan, out=other)
            return other

        for count, words in ((1, "a wait each"), (TURN, f"{TURN} calls a wait")):
            both = tuple(Way(functools.partial(run, count=count), each=count) for run in (repeated, ordinary))
            self.add(f"{what}, {words}", both, kernels, max(self.arguments.calls // count, 3))

    def add(self, what: str, ways: tuple[Way, ...], kernels: float, calls: int) -> None:
        """Add a row of a call in two ways; the plain or ordinary one is last."""
        short, other = ways
        with other.around():
            expected = [on_host(other.run(number)) for number in range(CHECKED)]
        # Three rounds, since programs are recorded in the first calls.
        bits = sum(differing_bits(short.run(i), one) for _ in range(3) for i, one in enumerate(expected))
        times, plain_times = in_turns(ways, calls, TURN)
        row = {
            "backend": self.device.info.selection, "device": self.device.info.name, "what": what, "calls": len(times),
            "median_s": float(np.median(times)), "most_s": float(np.quantile(times, 0.9)), "least_s": min(times),
            "plain_s": float(np.median(plain_times)), "kernels_s": kernels, "differing_bits": bits,
        }  # fmt: skip
        self.calls.append(row)
        note(table_line(call_cells(row)))

    # ---- several scans or models a call

    def run_several(self, name: str, make: Callable[..., Any], scans: np.ndarray) -> None:
        """Measure calls of several scans, and of several models."""
        model = make(backend=self.device)
        models = [make(backend=self.device) for _ in range(self.arguments.models)]
        for count in self.arguments.particles or [100, 500, 2000, 8000]:
            poses = np.stack([self.scene.cloud("tracking", count, SPREAD) for _ in scans]).astype(np.float64)
            size = f"{count} x {scans.shape[1]}"
            if "scans" in self.arguments.rows:
                what = f"{name}{len(scans)} scans of {size}"
                self.scans(what, model, poses, scans)
                if self.device.info.selection.startswith("warp:cuda"):
                    self.scans(f"{what}, on the device", model, on_device(self.device, poses), scans)
            if "models" in self.arguments.rows:
                self.models(f"{name}{len(models)} models, {size}", models, poses[0], scans[0])

    def scans(self, what: str, model: Any, poses: Any, scans: np.ndarray) -> None:
        """Add a row of several scans."""

        def one_call(_: int) -> Any:
            return model.log_likelihood(poses, scans)

        def calls(_: int) -> list[Any]:
            return [model.log_likelihood(poses[number], scan) for number, scan in enumerate(scans)]

        ways = {
            "together": Way(one_call, functools.partial(sharing, ALWAYS)),
            "queued": Way(one_call, functools.partial(sharing, NEVER)), "calls": Way(calls),
        }  # fmt: skip
        shared = poses.shape[1] * scans.shape[1] <= pipeline.TOGETHER[self.device.info.kind]
        self.add_several(what, ways, shared=shared)

    def models(self, what: str, models: list[Any], poses: np.ndarray, scan: np.ndarray) -> None:
        """Add a row of several models with launches queued in sequence."""
        ways = {
            "queued": Way(lambda _: gs.log_likelihoods(models, poses, scan)),
            "calls": Way(lambda _: [model.log_likelihood(poses, scan) for model in models]),
        }
        self.add_several(what, ways, shared=False)

    def add_several(self, what: str, ways: dict[str, Way], *, shared: bool) -> None:
        """Add a row of several ways; single calls are the last one."""
        results = []
        for way in ways.values():
            with way.around():
                results.append(rows_of(way.run(0)))
        bits = sum(
            differing_bits(one, other) for found in results for one, other in zip(found, results[-1], strict=True)
        )
        times = in_turns(list(ways.values()), 3, seconds=self.arguments.seconds)
        row = {
            "backend": self.device.info.selection, "device": self.device.info.name, "what": what, "shared": shared,
            "differing_bits": bits, **{f"{name}_s": min(taken) for name, taken in zip(ways, times, strict=True)},
        }  # fmt: skip
        self.several.append(row)
        note(table_line(several_cells(row)))


def rows_of(found: Any) -> list[np.ndarray]:
    """Return each scan's or model's result as an array on the host."""
    return [on_host(one) for one in found] if isinstance(found, list) else [*on_host(found)]


def call_cells(r: dict[str, Any]) -> list[Any]:
    """Format the cells of a row of calls of one scan."""
    times = f"{r['median_s'] * 1e3:.4f} ({r['most_s'] * 1e3:.4f}, {r['least_s'] * 1e3:.4f})"
    ratio = f"{r['median_s'] / r['plain_s']:.2f}"
    rest = [f"{r['plain_s'] * 1e3:.4f}", ratio, f"{r['kernels_s'] * 1e3:.4f}", r["differing_bits"]]
    return [r["backend"], r["device"], r["what"], times, *rest]


def several_cells(r: dict[str, Any]) -> list[Any]:
    """Format the cells of a row of calls of several scans or models."""
    names = ("together", "queued", "calls")
    times = [f"{r[f'{name}_s'] * 1e3:.3f}" if f"{name}_s" in r else "-" for name in names]
    ratios = [f"{r[f'{name}_s'] / r['calls_s']:.2f}" if f"{name}_s" in r else "-" for name in names[:2]]
    return [r["backend"], r["what"], *times, *ratios, "together" if r["shared"] else "queued", r["differing_bits"]]


def main() -> int:
    """Measure and write."""
    parser = make_parser(__doc__)
    parser.add_argument("--rows", nargs="+", choices=ROWS, default=ROWS)
    parser.add_argument(
        "--particles", type=int, action="append",
        help="of a scan, repeatable; default: 2000 and 4000 in calls of one, 100, 500, 2000 and 8000 in calls of more",
    )  # fmt: skip
    parser.add_argument("--beams", type=int, action="append", help="repeatable; default: 60")
    parser.add_argument("--scans", type=int, default=50, help="which calls of one take in turn, and calls of more all")
    parser.add_argument("--models", type=int, default=4, help="of each call of several")
    parser.add_argument("--calls", type=int, default=400, help="of a row of one scan")
    parser.add_argument("--seconds", type=float, default=3.0, help="of a row of several scans or models")
    add_scene(parser, 50.0, 10.0)
    arguments = parse(parser)
    arguments.beams = arguments.beams or [60]
    calls, several = [], []
    for selection in arguments.backend:
        bench = Bench(selection, arguments)
        bench.run()
        calls, several = calls + bench.calls, several + bench.several
    tables = [table(CALL_COLUMNS, map(call_cells, calls))] if calls else []
    tables += [table(SEVERAL_COLUMNS, map(several_cells, several))] if several else []
    devices = ", ".join(sorted({f"{row['backend']} is {row['device']}" for row in [*calls, *several]}))
    report = {"scene": bench.scene.label, "rows": calls, "several": several}
    publish(__file__, arguments, "\n\n".join(tables), report, f"Scene: {bench.scene.label}. Devices: {devices}.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
