"""Calls of few particles: what a call takes beside its kernels, and that no shorter way changes a bit.

    python bench/small_calls.py --backend opencl
    python bench/small_calls.py --backend warp:cuda:0 --output bench/results/small_calls_name

Times are of whole calls of ``log_likelihood``: NumPy arrays in and out, and poses and result on the device where that
is a GPU (arrays of Warp and pyopencl); for several scans in one call see ``several_scans.py``. Each is taken beside the
plain way (copies by commands, each launch started on its own), in turns, so that their ratio holds on a busy machine;
results of both must have the same bits. Bound calls (``bind``) are taken beside ``log_likelihood`` with the same
arrays, with a wait after each call and after many: with NumPy arrays (on GPUs launches that are kept go along with the
copies, with CUDA as one graph; on processors it is the ordinary call), and on the device. "Kernels" are the launches of
an ordinary call, started one after the other with everything on the device.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from speed import Recorder, publish

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.evaluation.worlds import building, cloud_around, free_pose, simulate_scan

MODELS = {"field": gs.LikelihoodFieldModel, "beam model": gs.BeamModel}
# What takes the number of a call.
Call = Callable[[int], Any]
# How the other way is gone.
Way = Callable[[], contextlib.AbstractContextManager[None]]
# Calls of one way before the other has its turn.
TURN = 20
# Calls whose results are compared.
CHECKED = 5


@contextlib.contextmanager
def plainly(device: Any) -> Iterator[None]:
    """The plain way of a backend; of a model's buffers for as long as they live."""
    names = [name for name in ("_gathers", "_shared") if hasattr(device, name)]
    before = {name: getattr(device, name) for name in names}
    for name in names:
        setattr(device, name, False)
    try:
        yield
    finally:
        for name, value in before.items():
            setattr(device, name, value)


def in_turns(short: Call, plain: Call, calls: int, way: Way, each: int) -> tuple[list[float], list[float]]:
    """Seconds of one of each calls of the short and of the other way."""
    times: tuple[list[float], list[float]] = ([], [])
    while len(times[0]) < calls:
        for run, found, how in ((short, times[0], contextlib.nullcontext()), (plain, times[1], way())):
            with how:
                run(0)
                for i in range(min(TURN, calls)):
                    start = time.perf_counter()
                    run(i)
                    found.append((time.perf_counter() - start) / each)
    return times


def on_device(device: Any, array: np.ndarray) -> Any:
    """An array in the memory of a GPU, of the library that drives it."""
    if device.info.backend == "opencl":
        import pyopencl.array

        return pyopencl.array.to_device(device.queue, array)
    import warp as wp

    dtype = {"float32": wp.float32, "float64": wp.float64}[array.dtype.name]
    return wp.array(array, dtype=dtype, device=device.info.selection.removeprefix("warp:"))


class Bench:
    """Measures one device."""

    def __init__(self, selection: str, arguments: argparse.Namespace) -> None:
        self.device, self.arguments = get_backend(selection), arguments
        self.rows: list[dict[str, Any]] = []
        rng = np.random.default_rng(arguments.seed)
        self.grid = building(arguments.seed, (arguments.size,) * 2)
        beams = arguments.beams
        self.scanner = gs.Scanner.uniform(
            angle_min=-np.pi, angle_increment=2 * np.pi / beams, count=beams, range_max=arguments.range_max
        )
        self.pose = free_pose(self.grid, rng, 0.3)
        mixture = gs.BeamParameters()
        self.scans = np.stack(
            [
                simulate_scan(self.grid, self.scanner, self.pose, mixture, rng, self.device)
                for _ in range(arguments.scans)
            ]
        )
        self.clouds = {
            count: cloud_around(self.pose, count, 0.1, 0.1, rng).astype(np.float64) for count in arguments.particles
        }

    def add(
        self, what: str, short: Call, plain: Call, kernels: float, calls: int, way: Way | None = None, each: int = 1
    ) -> None:
        """A row of a call in two ways, the other of which is the plain one unless one is given."""
        way = functools.partial(plainly, self.device) if way is None else way
        with way():
            expected = [read(plain(i)) for i in range(CHECKED)]
        # Three rounds: the first calls are not what the others are, since what is kept of a call is kept then.
        found = [read(short(i)) for _ in range(3) for i in range(CHECKED)]
        bits = sum(int(np.count_nonzero(one != other)) for one, other in zip(found, 3 * expected, strict=True))
        times, plain_times = in_turns(short, plain, calls, way, each)
        row = {
            "backend": self.device.info.selection, "device": self.device.info.name, "what": what, "calls": len(times),
            "median_s": float(np.median(times)), "most_s": float(np.quantile(times, 0.9)), "least_s": min(times),
            "plain_s": float(np.median(plain_times)), "kernels_s": kernels, "differing_bits": bits,
        }  # fmt: skip
        self.rows.append(row)
        print(to_markdown([row]).splitlines()[-1], file=sys.stderr, flush=True)

    def kernels(self, kind: Any, poses: np.ndarray) -> float:
        """Median seconds of the launches of a call."""
        recorder = Recorder(self.device)
        model = kind(self.grid, self.scanner, backend=recorder)
        model.log_likelihood(poses, self.scans[0])
        launches, times = recorder.launches_of(lambda: model.log_likelihood(poses, self.scans[0])), []
        for _ in range(self.arguments.calls):
            start = time.perf_counter()
            for launch in launches:
                launch()
            self.device.synchronize()
            times.append(time.perf_counter() - start)
        return float(np.median(times))

    def run(self) -> None:
        """All rows."""
        calls, scans = self.arguments.calls, self.scans
        for name, kind in MODELS.items():
            model = kind(self.grid, self.scanner, backend=self.device)
            with plainly(self.device):
                # Its buffers are made now, and large enough.
                plain = kind(self.grid, self.scanner, backend=self.device)
                plain.log_likelihood(max(self.clouds.values(), key=len), scans[0])
            for count, poses in self.clouds.items():
                kernels, size = self.kernels(kind, poses), f"{name}, {count} x {self.scanner.count}"
                for what, several in (("", 1), (", another scan each time", len(scans))):

                    def call(i: int, one: Any = model, poses: Any = poses, several: int = several) -> Any:
                        return one.log_likelihood(poses, scans[i % several])

                    self.add(
                        f"{size}, NumPy in and out{what}", call, functools.partial(call, one=plain), kernels, calls
                    )
                    if not self.gpu:
                        continue
                    there = on_device(self.device, poses)
                    out = on_device(self.device, np.zeros(count, np.float32))

                    def into(i: int, there: Any = there, out: Any = out, several: int = several, m: Any = model) -> Any:
                        return m.log_likelihood(there, scans[i % several], out=out)

                    self.add(f"{size}, on the device, out={what}", into, into, kernels, calls)
                    call_there = functools.partial(call, poses=there)
                    self.add(f"{size}, on the device{what}", call_there, call_there, kernels, calls)
                self.bound(f"{size}, bound", model, poses, kernels, np.array)
                if self.gpu:
                    there = functools.partial(on_device, self.device)
                    self.bound(f"{size}, bound, on the device", model, poses, kernels, there)
        graphs = getattr(self.device, "_graphs", None)
        if graphs is not None and self.device._gathers:
            refused = ", and the driver refused one" if graphs.failed else ""
            print(f"{self.device.info.selection}: {len(graphs._graphs)} graphs are kept{refused}", file=sys.stderr)

    @property
    def gpu(self) -> bool:
        """Whether the device has arrays of its own."""
        return bool(self.device.info.kind == "gpu")

    def bound(
        self, what: str, model: Any, poses: np.ndarray, kernels: float, there: Callable[[np.ndarray], Any]
    ) -> None:
        """A bound call against an ordinary one with the same arrays, of which the readings come from the host."""
        result, scan, calls = np.zeros(len(poses), np.float32), self.scans[0], self.arguments.calls
        given, own, other = there(poses), there(result), there(result)
        call = model.bind(given, there(scan), out=own)

        def repeated(_: int, count: int) -> Any:
            for _ in range(count):
                call()
            call.check()
            return call.out

        def ordinary(_: int, count: int) -> Any:
            for _ in range(count):
                model.log_likelihood(given, scan, out=other)
            return other

        for count, words in ((1, "a wait each"), (TURN, f"{TURN} calls a wait")):
            self.add(
                f"{what}, {words}", functools.partial(repeated, count=count), functools.partial(ordinary, count=count),
                kernels, max(calls // count, 3), contextlib.nullcontext, count,
            )  # fmt: skip


def read(array: Any) -> np.ndarray:
    """The bits of a result, wherever it is."""
    host = array if isinstance(array, np.ndarray) else array.get() if hasattr(array, "get") else array.numpy()
    return np.array(host).view(np.uint32)


def to_markdown(rows: list[dict[str, Any]]) -> str:
    """The rows as a table."""
    head = (
        "| backend | device | what | ms a call (90 %, least) | plain, ms | ratio | kernels, ms | differing bits |\n|"
        + " --- |" * 8
    )
    lines = [
        f"| {r['backend']} | {r['device']} | {r['what']} | {r['median_s'] * 1e3:.4f} ({r['most_s'] * 1e3:.4f}, "
        f"{r['least_s'] * 1e3:.4f}) | {r['plain_s'] * 1e3:.4f} | {r['median_s'] / r['plain_s']:.2f} "
        f"| {r['kernels_s'] * 1e3:.4f} | {r['differing_bits']} |"
        for r in rows
    ]
    return "\n".join([head, *lines])


def main() -> int:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backend", action="append", required=True, help="selection string; may be repeated")
    parser.add_argument("--particles", type=int, action="append", help="default: 2000 and 4000")
    parser.add_argument("--beams", type=int, default=60)
    parser.add_argument("--scans", type=int, default=100, help="that calls of other scans take in turn")
    parser.add_argument("--size", type=float, default=50.0, help="side of the built-in building in metres")
    parser.add_argument("--range-max", type=float, default=10.0)
    parser.add_argument("--calls", type=int, default=400)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--commit", default="", help="for a copy of the tree that is no git repository")
    parser.add_argument("--output", type=Path, help="path without ending for the .json and .md files")
    arguments = parser.parse_args()
    arguments.particles = arguments.particles or [2000, 4000]
    rows = []
    for selection in arguments.backend:
        bench = Bench(selection, arguments)
        bench.run()
        rows += bench.rows
    scene = f"built-in building, {bench.grid.shape[0]} x {bench.grid.shape[1]} cells, range_max {arguments.range_max:g}"
    publish("small_calls.py", arguments, to_markdown(rows), {"scene": scene, "rows": rows}, f"Scene: {scene}.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
