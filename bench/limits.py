"""The rates that gpusense is to reach, measured: whole calls, launches alone, small calls, preparation, large maps.

    python bench/limits.py --backend opencl --particles 4096           # a processor
    python bench/limits.py --backend opencl --backend warp:cuda:0 --particles 100000 --large --output bench/results/name

Rows are of the built-in building of 2000 x 2000 cells (or --map) with a cloud over the whole map and one around a pose.
Launches are all kernels of a call with its arrays on the device: placing the poses, ordering them, casting, scoring and
summing, started as the call starts them (on CUDA as one graph). "Alone" each set is waited for, "in a row" ten are.
Errors are against float64 NumPy on the first particles; ranges must be float32 NumPy's to the bit. Times are the least
and the median of several runs; machines are noisy, so compare within a run.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from speed import Recorder, best, publish, started_together

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.evaluation.worlds import building, cloud_around, cloud_uniform, free_pose

CHECKED = 100
# Sets of launches that are waited for together.
IN_A_ROW = 10


class Bench:
    """Measures one device."""

    def __init__(self, backend: str, arguments: argparse.Namespace) -> None:
        self.device, self.arguments = Recorder(get_backend(backend)), arguments
        self.rows: list[dict[str, Any]] = []

    def add(self, what: str, work: float, run: Callable[[], Any], check: Callable[[], float] | None = None) -> None:
        """A row of a call that does so much work: its own time, and that of its launches."""
        run()
        launches = self.device.launches_of(run)
        least, median = best(run, self.arguments.repeats, self.arguments.seconds)

        start = started_together(self.device, launches)

        def again(times: int = 1) -> None:
            for _ in range(times):
                start()
            self.device.synchronize()

        alone, _ = best(again, self.arguments.repeats, self.arguments.seconds)
        in_a_row, _ = best(lambda: again(IN_A_ROW), self.arguments.repeats, self.arguments.seconds)
        row = {
            "backend": self.device.info.selection, "device": self.device.info.name, "driver": self.device.info.driver,
            "what": what, "work": work, "call_s": least, "median_s": median, "launches": len(launches),
            "launch_s": alone, "row_s": in_a_row / IN_A_ROW,
            "error": check() if check else None,
        }  # fmt: skip
        self.rows.append(row)
        print(to_markdown([row]).splitlines()[-1], file=sys.stderr, flush=True)


def to_markdown(rows: list[dict[str, Any]]) -> str:
    """The rows as a table."""
    head = (
        "| backend | what | M/s, NumPy in and out | M/s, launches alone | M/s, in a row | ms a call (median) "
        "| launches | ms, launches alone | ms, in a row | max error |\n" + "| --- " * 10 + "|"
    )
    lines = []
    for r in rows:
        rates = [f"{r['work'] / r[key] / 1e6:.4g}" if r["work"] > 1 else "" for key in ("call_s", "launch_s", "row_s")]
        error = "" if r["error"] is None else f"{r['error']:.1e}"
        lines.append(
            f"| {r['backend']} | {r['what']} | {' | '.join(rates)} | {r['call_s'] * 1e3:.4g} "
            f"({r['median_s'] * 1e3:.4g}) | {r['launches']} | {r['launch_s'] * 1e3:.4g} | {r['row_s'] * 1e3:.4g} "
            f"| {error} |"
        )
    return "\n".join([head, *lines])


def measure(backend: str, arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """All rows of one device."""
    bench = Bench(backend, arguments)
    device, rng = bench.device, np.random.default_rng(arguments.seed)
    grid = gs.read_map(arguments.map) if arguments.map else building(0, (arguments.size,) * 2)
    pose = free_pose(grid, rng, 0.3)
    clouds = {
        "global": lambda n: cloud_uniform(grid, n, rng),
        "tracking": lambda n: cloud_around(pose, n, 0.3, 0.1, rng),
    }

    def scanner_of(beams: int) -> gs.Scanner:
        return gs.Scanner(np.linspace(-np.pi, np.pi, beams, endpoint=False), 30.0)

    def scan(scanner: gs.Scanner) -> np.ndarray:
        return np.minimum(gs.RayCaster(grid, 30.0, backend="numpy").cast(pose[None], scanner.bearings)[0], 29.9)

    scanner = scanner_of(arguments.beams)
    z = scan(scanner)
    for name, cloud in clouds.items():
        poses = cloud(arguments.particles)
        work, some = len(poses) * arguments.beams, poses[:CHECKED]
        caster = gs.RayCaster(grid, 30.0, backend=device)
        right = gs.RayCaster(grid, 30.0, backend="numpy").cast(some, scanner.bearings)
        ranges = np.empty((len(poses), arguments.beams), np.float32)

        def differing(ranges: np.ndarray = ranges, right: np.ndarray = right) -> float:
            assert (ranges[:CHECKED] == right).all(), "ranges have other bits than NumPy's"
            return 0.0

        bench.add(
            f"rays, {name}, {len(poses)} x {arguments.beams}", work,
            lambda c=caster, p=poses, r=ranges: c.cast(p, scanner.bearings, out=r), differing,
        )  # fmt: skip
        for kind in (gs.BeamModel, gs.LikelihoodFieldModel):
            model = kind(grid, scanner, backend=device)
            truth = kind(grid, scanner, backend="numpy", precision="float64").log_likelihood(some, z)
            bench.add(
                f"{'beam model' if kind is gs.BeamModel else 'field'}, {name}, {len(poses)} x {arguments.beams}", work,
                lambda m=model, p=poses: m.log_likelihood(p, z),
                lambda m=model, p=poses, t=truth: float(np.abs(m.log_likelihood(p, z)[:CHECKED] - t).max()),
            )  # fmt: skip
    small = scanner_of(60)
    for count in (2000, 4000):
        for kind in (gs.LikelihoodFieldModel, gs.BeamModel):
            name = "beam model" if kind is gs.BeamModel else "field"
            model, readings, poses = kind(grid, small, backend=device), scan(small), clouds["tracking"](count)
            what = f"{name}, tracking, {count} x 60"
            bench.add(what, count * 60, lambda m=model, p=poses, r=readings: m.log_likelihood(p, r))
            if device.info.backend == "warp" and device.info.kind == "gpu":
                import warp as wp

                there = wp.array(poses, dtype=wp.float64, device=device.info.selection.removeprefix("warp:"))
                out = wp.empty(count, dtype=wp.float32, device=there.device)
                bench.add(
                    f"{what}, poses and result on the device", count * 60,
                    lambda m=model, p=there, r=readings, o=out: m.log_likelihood(p, r, out=o),
                )  # fmt: skip
    for kind in (gs.BeamModel, gs.LikelihoodFieldModel):
        name = "beam model" if kind is gs.BeamModel else "field"
        everywhere = clouds["global"](1000)
        bench.add(f"preparation, {name}", 1, lambda k=kind, p=everywhere: k(grid, scanner, backend=device).prepare(p))
    if arguments.large:
        wide, poses = scanner_of(1080), clouds["tracking"](1_000_000)
        model, readings = gs.LikelihoodFieldModel(grid, wide, backend=device), scan(wide)
        for name, cloud in clouds.items():
            poses = cloud(1_000_000)
            bench.add(
                f"field, {name}, 1000000 x 1080", 1080e6, lambda m=model, p=poses, r=readings: m.log_likelihood(p, r)
            )
        grid = building(0, (1000.0, 1000.0))
        poses, caster = cloud_uniform(grid, 1_000_000, rng), gs.BeamModel(grid, scanner, backend=device)
        bench.add(
            f"beam model, global, 1000000 x {arguments.beams}, map of {grid.shape[0]} x {grid.shape[1]}",
            1e6 * arguments.beams, lambda m=caster, p=poses: m.log_likelihood(p, z),
        )  # fmt: skip
    return bench.rows


def main() -> int:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backend", action="append", required=True, help="selection string; more than once for more")
    parser.add_argument("--particles", type=int, default=4096)
    parser.add_argument("--beams", type=int, default=360)
    parser.add_argument("--map", type=Path, help="a map_server YAML instead of the built-in building")
    parser.add_argument("--size", type=float, default=100.0, help="side of the built-in building in metres")
    parser.add_argument("--large", action="store_true", help="a million particles, and a map of 20 000 x 20 000 cells")
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--seconds", type=float, default=3.0, help="longest time of the repeats of one row")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--commit", default="", help="for a copy of the tree that is no git repository")
    parser.add_argument("--output", type=Path, help="path without ending for the .json and .md files")
    arguments = parser.parse_args()
    rows = [row for backend in arguments.backend for row in measure(backend, arguments)]
    publish("limits.py", arguments, to_markdown(rows), {"rows": rows})
    return 0


if __name__ == "__main__":
    sys.exit(main())
