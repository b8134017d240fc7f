"""Measure the efficiency of a sweep: the same jobs on 1, 2, ... workers, each with its own device.

    python bench/speed/sweeps.py --device numpy --workers 1 2 --output bench/results/sweeps_cpu
    python bench/speed/sweeps.py --device warp:cuda:0 --device warp:cuda:1 --workers 1 2 --engine dask

Jobs track a robot along a simulated run in a generated building, each with another seed. Every worker runs jobs before
the measurement, so that no kernel is compiled during it; sweeps of all numbers of workers take turns. Efficiency is the
least time on one worker over the least on n, times 1 / n. "Busy" is the share of the workers' time in jobs; the engine
and the table take the rest. On busy processors efficiency says little: also compare the processor time of a job. The
tables of all sweeps must be equal except for times and places; otherwise the exit code is 1.
"""

from __future__ import annotations

import contextlib
import sys
import tempfile
import time
from concurrent.futures import Executor
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from common import make_parser, note, parse, publish, table

import gpusense as gs
from gpusense.evaluation.worlds import building, free_pose, simulate_scan
from gpusense.sweeps.tasks import is_timing


def write_run(folder: Path, beams: int, scans: int, seed: int) -> None:
    """Write a map and a log of a robot that turns on the spot and drives a little."""
    grid, rng = building(), np.random.default_rng(seed)
    gs.write_map(grid, folder / "map.yaml")
    scanner = gs.Scanner.uniform(angle_min=-np.pi / 2, angle_increment=np.pi / (beams - 1), count=beams, range_max=20.0)
    pose, odometry, lines = np.asarray(free_pose(grid, rng)), np.zeros(3), []
    for step in range(scans):
        ranges = simulate_scan(grid, scanner, pose, gs.BeamParameters(), rng)
        numbers = [*np.minimum(ranges, 20.0), *pose, *odometry]
        lines.append(f"FLASER {beams} {' '.join(f'{value:.4f}' for value in numbers)} {step}.0 robot {step}.0")
        motion = np.array([0.0, 0.0, 0.1])
        pose, odometry = gs.compose_poses(pose, motion), gs.compose_poses(odometry, motion)
    (folder / "run.log").write_text("\n".join(lines))


def executor_of(engine: str, devices: list[str]) -> Executor:
    """Return the executor of an engine."""
    if engine == "dask":
        return gs.sweep.DaskExecutor(devices=devices)
    return gs.sweep.ProcessExecutor(devices)


def swept(
    jobs: list[Any], executor: Executor, folder: Path, name: str
) -> tuple[float, float, float, dict[str, list[Any]]]:
    """Return the seconds of a sweep, elapsed and processor seconds of its jobs, and its table without times."""
    begin = time.perf_counter()
    ended = gs.sweep.run(jobs, table=folder / f"{name}.csv", executor=executor, root=folder)
    seconds = time.perf_counter() - begin
    columns = gs.sweep.read_table(ended.table)
    if ended.failed:
        raise SystemExit(f"jobs failed: {set(columns['error'])}")
    return (
        seconds,
        sum(columns["seconds"]),
        sum(columns["cpu_seconds"]),
        {key: value for key, value in columns.items() if not is_timing(key)},
    )


def measure(arguments: Any, folder: Path) -> list[dict[str, Any]]:
    """Return a row for each number of workers; sweeps run in turns."""
    options = {"particles": arguments.particles, "range_max": 20.0}

    def jobs_of(first: int, count: int) -> list[Any]:
        common = dict(map="map.yaml", log="run.log", model=arguments.model, options=options)
        return [gs.sweep.Job(**common, seed=first + k) for k in range(count)]

    jobs, tables = jobs_of(0, arguments.jobs), []
    times: dict[int, list[float]] = {n: [] for n in arguments.workers}
    busy: dict[int, list[float]] = {n: [] for n in arguments.workers}
    used: dict[int, list[float]] = {n: [] for n in arguments.workers}
    devices = {n: [arguments.device[k % len(arguments.device)] for k in range(n)] for n in arguments.workers}
    with contextlib.ExitStack() as stack:
        executors = {n: stack.enter_context(executor_of(arguments.engine, devices[n])) for n in arguments.workers}
        for n, executor in executors.items():
            swept(jobs_of(100_000, 4 * n), executor, folder, f"warm{n}")
        for turn in range(arguments.repeats):
            for n, executor in executors.items():
                seconds, own, cpu, columns = swept(jobs, executor, folder, f"run{n}_{turn}")
                times[n].append(seconds)
                busy[n].append(own / seconds / n)
                used[n].append(cpu / len(jobs))
                tables.append(columns)
                note(f"{n} workers: {seconds:.2f} s")
    arguments.differing = sorted({name for one in tables for name in one if one[name] != tables[0].get(name)})
    base = min(times[arguments.workers[0]]) * arguments.workers[0]
    return [
        dict(workers=n, devices=devices[n], seconds=min(each), all_seconds=each, jobs_per_second=len(jobs) / min(each),
             speedup=base / min(each), efficiency=base / min(each) / n, busy=float(np.median(busy[n])),
             cpu_seconds=min(used[n]))
        for n, each in times.items()
    ]  # fmt: skip


def main() -> int:
    """Measure and write."""
    parser = make_parser(__doc__, backend="")
    parser.add_argument("--device", action="append", help="of each worker, repeatable (default: numpy)")
    parser.add_argument("--engine", choices=("processes", "dask"), default="processes")
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--model", choices=("field", "beam"), default="field")
    parser.add_argument("--jobs", type=int, default=24)
    parser.add_argument("--particles", type=int, default=1000)
    parser.add_argument("--beams", type=int, default=61)
    parser.add_argument("--scans", type=int, default=20, help="of a job")
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parse(parser)
    arguments.device = arguments.device or ["numpy"]
    with tempfile.TemporaryDirectory() as folder:
        write_run(Path(folder), arguments.beams, arguments.scans, arguments.seed)
        rows = measure(arguments, Path(folder))
    columns = ("workers", "devices", "jobs", "s", "jobs/s", "times", "efficiency", "busy", "CPU s a job")
    lines = [
        (row["workers"], ", ".join(dict.fromkeys(row["devices"])), arguments.jobs, f"{row['seconds']:.2f}",
         f"{row['jobs_per_second']:.2f}", f"{row['speedup']:.2f}", f"{row['efficiency']:.2f}",
         f"{row['busy']:.2f}", f"{row['cpu_seconds']:.3f}")
        for row in rows
    ]  # fmt: skip
    equal = f"tables that differ in {', '.join(arguments.differing)}" if arguments.differing else "equal tables"
    remark = (
        f"{arguments.engine}; {arguments.model}, {arguments.particles} particles, {arguments.beams} beams, "
        f"{arguments.scans} scans a job; least of {arguments.repeats}; {equal}."
    )
    publish(__file__, arguments, table(columns, lines), {"rows": rows, "differing": arguments.differing}, remark)
    return 1 if arguments.differing else 0


if __name__ == "__main__":
    sys.exit(main())
