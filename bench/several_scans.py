"""Several scans or models in one call against as many calls, and where common launches begin to pay.

    python bench/several_scans.py --backend opencl --backend warp:cpu
    python bench/several_scans.py --backend warp:cuda:0 --particles 500 --particles 8000 --output bench/results/several

Each row has three ways, in turns in one run, so that their ratios hold on a busy machine: one call whose scans share
launches however large they are, one call whose scans are queued one after the other, and a call for each. The library
takes the first way up to so many particle-beams of a scan (``gpusense.models.scan.call.TOGETHER``), and beyond it the
second. Times are least ones of whole calls, NumPy arrays in and out; on Warp's CUDA also of arrays on the device. All
ways must have the same bits.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from small_calls import MODELS, on_device, read
from speed import publish

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.evaluation.worlds import building, cloud_around, free_pose, simulate_scan
from gpusense.models.scan import model as scan_model
from gpusense.models.scan.call import TOGETHER

ALWAYS, NEVER = 1 << 62, 0
WAYS = ("together", "queued", "calls")


def with_limit(limit: int, call: Callable[[], Any]) -> Callable[[], Any]:
    """A call while scans of up to so many particle-beams share launches."""

    def limited() -> Any:
        scan_model.TOGETHER = dict.fromkeys(TOGETHER, limit)
        try:
            return call()
        finally:
            scan_model.TOGETHER = TOGETHER

    return limited


def in_turns(ways: list[Callable[[], Any]], seconds: float) -> list[float]:
    """Least seconds of each way, which take turns for so long, and at least three times."""
    times: list[list[float]] = [[] for _ in ways]
    begin = time.perf_counter()
    while len(times[0]) < 3 or time.perf_counter() - begin < seconds:
        for way, found in zip(ways, times, strict=True):
            start = time.perf_counter()
            way()
            found.append(time.perf_counter() - start)
    return [min(found) for found in times]


class Bench:
    """Measures one device."""

    def __init__(self, selection: str, arguments: argparse.Namespace) -> None:
        self.device, self.arguments = get_backend(selection), arguments
        self.rows: list[dict[str, Any]] = []
        self._rng = np.random.default_rng(arguments.seed)
        self.grid = building(arguments.seed, (arguments.size,) * 2)
        self.pose = free_pose(self.grid, self._rng, 0.3)

    def run(self) -> None:
        """All rows."""
        scans, seconds = self.arguments.scans, self.arguments.seconds
        there = self.device.info.selection.startswith("warp:cuda")
        for beams in self.arguments.beams:
            scanner = gs.Scanner.uniform(
                angle_min=-np.pi, angle_increment=2 * np.pi / beams, count=beams, range_max=self.arguments.range_max
            )
            book = gs.BeamParameters()
            ranges = np.stack([simulate_scan(self.grid, scanner, self.pose, book, self._rng) for _ in range(scans)])
            for name, kind in MODELS.items():
                model = kind(self.grid, scanner, backend=self.device)
                models = [kind(self.grid, scanner, backend=self.device) for _ in range(self.arguments.models)]
                for count in self.arguments.particles:
                    poses = np.stack([cloud_around(self.pose, count, 0.1, 0.1, self._rng) for _ in range(scans)])
                    poses, size = poses.astype(np.float64), f"{count} x {beams}"
                    self.scans(f"{name}, {scans} scans of {size}", model, poses, ranges)
                    if there:
                        own = on_device(self.device, poses)
                        self.scans(f"{name}, {scans} scans of {size}, on the device", model, own, ranges)
                    self.models(f"{name}, {len(models)} models, {size}", models, poses[0], ranges[0], seconds)

    def scans(self, what: str, model: Any, poses: Any, ranges: np.ndarray) -> None:
        """A row of several scans."""

        def one_call() -> Any:
            return model.log_likelihood(poses, ranges)

        def calls() -> list[Any]:
            return [model.log_likelihood(poses[i], scan) for i, scan in enumerate(ranges)]

        ways = [with_limit(ALWAYS, one_call), with_limit(NEVER, one_call), calls]
        shared = poses.shape[1] * ranges.shape[1] <= TOGETHER[self.device.info.kind]
        self.add(what, ways, self.arguments.seconds, shared=shared)

    def models(self, what: str, models: list[Any], poses: np.ndarray, ranges: np.ndarray, seconds: float) -> None:
        """A row of several models, whose launches are queued one after the other."""

        def one_call() -> list[Any]:
            return gs.log_likelihoods(models, poses, ranges)

        def calls() -> list[Any]:
            return [model.log_likelihood(poses, ranges) for model in models]

        self.add(what, [one_call, calls], seconds)

    def add(self, what: str, ways: list[Callable[[], Any]], seconds: float, *, shared: bool = False) -> None:
        """A row of two or three ways, of which the last are calls one by one."""
        bits = [bits_of(way()) for way in ways]
        differing = sum(
            int(np.count_nonzero(one != other)) for way in bits for one, other in zip(way, bits[-1], strict=True)
        )
        times = in_turns(ways, seconds)
        names = WAYS if len(ways) == 3 else WAYS[1:]
        row = {
            "backend": self.device.info.selection, "device": self.device.info.name, "what": what, "shared": shared,
            "differing_bits": differing, **{f"{name}_s": t for name, t in zip(names, times, strict=True)},
        }  # fmt: skip
        self.rows.append(row)
        print(to_markdown([row]).splitlines()[-1], file=sys.stderr, flush=True)


def bits_of(found: Any) -> list[np.ndarray]:
    """The bits of each scan's or model's result."""
    return [read(one) for one in found] if isinstance(found, list) else [*read(found)]


def to_markdown(rows: list[dict[str, Any]]) -> str:
    """The rows as a table."""
    head = "| backend | what | together, ms | queued, ms | calls, ms | together / calls | queued / calls | way |"
    lines = [head + " differing bits |", "|" + " --- |" * 9]
    for r in rows:
        together = r.get("together_s")
        shown, ratio = ("-", "-") if together is None else (f"{together * 1e3:.3f}", f"{together / r['calls_s']:.2f}")
        lines.append(
            f"| {r['backend']} | {r['what']} | {shown} | {r['queued_s'] * 1e3:.3f} | {r['calls_s'] * 1e3:.3f} "
            f"| {ratio} | {r['queued_s'] / r['calls_s']:.2f} | {'together' if r['shared'] else 'queued'} "
            f"| {r['differing_bits']} |"
        )
    return "\n".join(lines)


def main() -> int:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backend", action="append", required=True, help="selection string; may be repeated")
    parser.add_argument("--particles", type=int, action="append", help="of each scan; default: 100, 500, 2000, 8000")
    parser.add_argument("--beams", type=int, action="append", help="default: 60")
    parser.add_argument("--scans", type=int, default=50, help="of each call")
    parser.add_argument("--models", type=int, default=4, help="of each call of several")
    parser.add_argument("--size", type=float, default=50.0, help="side of the built-in building in metres")
    parser.add_argument("--range-max", type=float, default=10.0)
    parser.add_argument("--seconds", type=float, default=3.0, help="of each row")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--commit", default="", help="for a copy of the tree that is no git repository")
    parser.add_argument("--output", type=Path, help="path without ending for the .json and .md files")
    arguments = parser.parse_args()
    arguments.particles = arguments.particles or [100, 500, 2000, 8000]
    arguments.beams = arguments.beams or [60]
    rows = []
    for selection in arguments.backend:
        bench = Bench(selection, arguments)
        bench.run()
        rows += bench.rows
    devices = ", ".join(sorted({f"{row['backend']} is {row['device']}" for row in rows}))
    scene = f"built-in building, {bench.grid.shape[0]} x {bench.grid.shape[1]} cells, range_max {arguments.range_max:g}"
    note = f"Scene: {scene}. Devices: {devices}."
    publish("several_scans.py", arguments, to_markdown(rows), {"scene": scene, "rows": rows}, note)
    return 0


if __name__ == "__main__":
    sys.exit(main())
