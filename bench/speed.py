"""Speed and error of ray casting, beam model and likelihood field on the devices of this machine.

    python bench/speed.py                            # built-in building, every device present
    python bench/speed.py --backend opencl --particles 100000 --beams 360 --output bench/results/name

Writes a Markdown table and a JSON file with machine, sizes, times, errors and the command. Times are of one call with
NumPy arrays in and out, of the launch alone with its arrays on the device, and of the first call with compilation and
map preparation. Errors are against float64 NumPy on the first particles.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shlex
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.evaluation.worlds import building, cloud_around, cloud_uniform, free_pose, simulate_scan

CHECKED = 200


class Recorder:
    """Remembers the launches of a backend, so that they can be timed again with everything on the device."""

    def __init__(self, backend: Any) -> None:
        self._backend = backend
        self.launches: list[Callable[[], None]] = []
        self._listening = False

    def mark(self) -> object | None:
        """The backend's; what it would repeat is not repeated while each launch is to be heard of."""
        return None if self._listening else self._backend.mark()

    def launches_of(self, run: Callable[[], Any]) -> list[Callable[[], None]]:
        """The launches of a call."""
        self.launches.clear()
        self._listening = True
        try:
            run()
        finally:
            self._listening = False
        launches, self.launches = self.launches, []
        return launches

    def __getattr__(self, name: str) -> Any:
        return getattr(self._backend, name)

    def compile(self, kernel: str, flags: frozenset[str]) -> Any:
        """The backend's launcher, remembered with its arguments."""
        launcher = self._backend.compile(kernel, flags)

        def launch(size: tuple[int, ...], *arguments: Any) -> None:
            self.launches.append(lambda: launcher(size, *arguments))
            launcher(size, *arguments)

        return launch


def started_together(device: Any, launches: list[Callable[[], None]]) -> Callable[[], None]:
    """What starts some launches the way a call starts them: on CUDA devices as one graph."""

    def each() -> None:
        for launch in launches:
            launch()

    if device.info.kind != "gpu" or not hasattr(device, "record"):
        return each
    replay = device.record(each)
    # The first time each is started on its own, the second time the graph is made.
    replay()
    replay()
    device.synchronize()
    return replay


@dataclass(frozen=True)
class Scene:
    """The built-in building with a cloud over all of it and one around a pose, and a scan taken there."""

    grid: gs.OccupancyGrid
    clouds: dict[str, np.ndarray]
    scanner: gs.Scanner
    scan: np.ndarray

    def launches(self, device: Recorder, what: str, poses: np.ndarray) -> list[Callable[[], None]]:
        """The launches of a call for ``what``: rays, beam model or field."""
        if what == "rays":
            caster = gs.RayCaster(self.grid, 30.0, backend=cast(Any, device))
            out = np.empty((len(poses), self.scanner.count), np.float32)

            def run() -> Any:
                return caster.cast(poses, self.scanner.bearings, out=out)

        else:
            kind = gs.BeamModel if what == "beam model" else gs.LikelihoodFieldModel
            model = kind(self.grid, self.scanner, backend=cast(Any, device))

            def run() -> Any:
                return model.log_likelihood(poses, self.scan)

        run()
        return device.launches_of(run)


def scene_of(arguments: argparse.Namespace) -> Scene:
    """The scene of --particles, --beams, --size and --seed."""
    rng = np.random.default_rng(arguments.seed)
    grid = building(0, (arguments.size,) * 2)
    pose = free_pose(grid, rng, 0.3)
    count = arguments.particles
    clouds = {"global": cloud_uniform(grid, count, rng), "tracking": cloud_around(pose, count, 0.3, 0.1, rng)}
    scanner = gs.Scanner(np.linspace(-np.pi, np.pi, arguments.beams, endpoint=False), 30.0)
    scan = np.minimum(gs.RayCaster(grid, 30.0, backend="numpy").cast(pose[None], scanner.bearings)[0], 29.9)
    return Scene(grid, clouds, scanner, scan)


def best(run: Callable[[], Any], repeats: int, longest: float) -> tuple[float, float]:
    """Minimum and median seconds of some calls, fewer where they take longer than ``longest`` altogether."""
    times: list[float] = []
    while len(times) < repeats and (not times or sum(times) + times[-1] < longest):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return min(times), float(np.median(times))


def measure(
    name: str,
    make: Callable[[Any, str], Any],
    backend: str,
    poses: np.ndarray,
    work: int,
    arguments: argparse.Namespace,
    call: Callable[[Any, np.ndarray], np.ndarray],
) -> dict[str, Any]:
    """One row: times of a model's call on a device, and its largest and median error."""
    device = Recorder(get_backend(backend))
    start = time.perf_counter()
    model = make(device, "float32")
    result = call(model, poses)
    first = time.perf_counter() - start
    least, median = best(lambda: call(model, poses), arguments.repeats, arguments.seconds)
    launches = device.launches_of(lambda: call(model, poses))

    start_all = started_together(device, launches)

    def launch() -> None:
        start_all()
        device.synchronize()

    kernel, _ = best(launch, arguments.repeats, arguments.seconds)
    truth = call(make("numpy", "float64"), poses[:CHECKED])
    same = call(make("numpy", "float32"), poses[:CHECKED])
    error = np.abs(result[:CHECKED].astype(np.float64) - truth)
    info = device.info
    return {
        "backend": info.selection, "device": info.name, "driver": info.driver, "what": name,
        "first_s": first, "steady_s": least, "median_s": median, "launch_s": kernel,
        "rate": work / least, "launch_rate": work / kernel,
        "median_error": float(np.median(error)), "max_error": float(error.max()),
        "bits_from_numpy": int(np.count_nonzero(result[:CHECKED] != same)), "checked": int(error.size),
    }  # fmt: skip


def rows_of(backend: str, clouds: dict[str, np.ndarray], scene: Any, arguments: argparse.Namespace) -> list[dict]:
    """All rows of one device."""
    grid, scanner, ranges = scene
    hits = int(np.count_nonzero(gs.classify(ranges, scanner) == gs.Reading.HIT))
    bilinear = gs.LikelihoodFieldParameters(interpolation="bilinear")
    rows = []
    for cloud, poses in clouds.items():
        cast_poses = poses[: max(arguments.particles // 4, 1)]
        jobs = (
            ("ray casting", lambda b, p: gs.RayCaster(grid, scanner.range_max, backend=b, precision=p),
             lambda m, x: m.cast(x, scanner.bearings), cast_poses, scanner.count),
            ("beam model", lambda b, p: gs.BeamModel(grid, scanner, backend=b, precision=p),
             lambda m, x: m.log_likelihood(x, ranges), poses, hits),
            ("field, nearest", lambda b, p: gs.LikelihoodFieldModel(grid, scanner, backend=b, precision=p),
             lambda m, x: m.log_likelihood(x, ranges), poses, hits),
            ("field, bilinear", lambda b, p: gs.LikelihoodFieldModel(grid, scanner, bilinear, backend=b, precision=p),
             lambda m, x: m.log_likelihood(x, ranges), poses, hits),
        )  # fmt: skip
        for name, make, call, some, beams in jobs:
            row = measure(name, make, backend, some, len(some) * beams, arguments, call)
            rows.append({"cloud": cloud, "particles": len(some), "beams": beams, **row})
            print(to_markdown(rows[-1:]).splitlines()[-1], file=sys.stderr, flush=True)
    return rows


def to_markdown(rows: list[dict]) -> str:
    """The rows as a table."""
    head = (
        "| backend | device | what | cloud | particles x beams | M/s, arrays in and out | M/s, launch alone "
        "| first call s | median / max error | differing bits of checked |\n|" + " --- |" * 10
    )
    lines = [
        f"| {r['backend']} | {r['device']} | {r['what']} | {r['cloud']} | {r['particles']} x {r['beams']} "
        f"| {r['rate'] / 1e6:.4g} | {r['launch_rate'] / 1e6:.4g} | {r['first_s']:.2f} "
        f"| {r['median_error']:.1e} / {r['max_error']:.1e} | {r['bits_from_numpy']} of {r['checked']} |"
        for r in rows
    ]
    return "\n".join([head, *lines])


def command_line(script: str) -> str:
    """The command as typed, absolute paths by their last part."""
    words = [Path(word).name if Path(word).is_absolute() else word for word in sys.argv[1:]]
    return shlex.join(["python", script, *words])


def machine(commit: str) -> dict[str, str]:
    """What the figures depend on beside the device; the commit is asked of git where it is not given."""
    commit = commit or subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False,
        cwd=Path(__file__).parent,
    ).stdout.strip()  # fmt: skip
    return {
        "date": time.strftime("%Y-%m-%d"), "python": platform.python_version(), "numpy": np.__version__,
        "gpusense": gs.__version__, "commit": commit, "platform": platform.platform(terse=True),
        "threads": str(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()),
    }  # fmt: skip


def write_report(output: Path, report: dict[str, Any], text: str) -> None:
    """Write a report beside its text: a path without ending, for a .json and a .md file."""
    output.parent.mkdir(parents=True, exist_ok=True)
    output.with_suffix(".json").write_text(json.dumps(report, indent=1) + "\n")
    output.with_suffix(".md").write_text(text)


def publish(script: str, arguments: argparse.Namespace, table: str, report: dict[str, Any], note: str = "") -> None:
    """Print a script's table with machine and command below it, and write both and the report where --output says."""
    command, host = command_line(f"bench/{script}"), machine(arguments.commit)
    if getattr(arguments, "data", None) is not None:
        # The folder of the data is no one's business.
        command = command.replace(str(arguments.data), "DATA")
    described = ", ".join(f"{name} {value}" for name, value in host.items())
    text = f"{table}\n\n{note and note + ' '}Machine: {described}. Command: `{command}`.\n"
    print(text)
    if arguments.output:
        write_report(arguments.output, {"command": command, "machine": host, **report}, text)


def main() -> int:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backend", action="append", help="selection string; default: every device present")
    parser.add_argument("--particles", type=int, default=20_000)
    parser.add_argument("--beams", type=int, default=180)
    parser.add_argument("--size", type=float, default=50.0, help="side of the built-in building in metres")
    parser.add_argument("--map", type=Path, help="a map_server YAML instead of the built-in building")
    parser.add_argument("--range-max", type=float, default=30.0)
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=5.0, help="longest time of the repeats of one row")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--commit", default="", help="for a copy of the tree that is no git repository")
    parser.add_argument("--output", type=Path, help="path without ending for the .json and .md files")
    arguments = parser.parse_args()
    rng = np.random.default_rng(arguments.seed)
    grid = gs.read_map(arguments.map) if arguments.map else building(arguments.seed, (arguments.size,) * 2)
    step = 2 * np.pi / max(arguments.beams, 1)
    scanner = gs.Scanner.uniform(
        angle_min=-np.pi, angle_increment=step, count=arguments.beams, range_max=arguments.range_max
    )
    pose = free_pose(grid, rng)
    ranges = simulate_scan(grid, scanner, pose, gs.BeamParameters(), rng)
    clouds = {
        "global": cloud_uniform(grid, arguments.particles, rng),
        "tracking": cloud_around(pose, arguments.particles, 0.3, 0.1, rng),
    }
    present = [d.selection for d in gs.devices() if d.available and d.kind != "simulator"]
    rows = []
    for backend in arguments.backend or present:
        rows += rows_of(backend, clouds, (grid, scanner, ranges), arguments)
    scene = f"{arguments.map.name if arguments.map else 'built-in building'}, {grid.shape[0]} x {grid.shape[1]} cells"
    publish("speed.py", arguments, to_markdown(rows), {"scene": scene, "rows": rows}, f"Scene: {scene}.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
