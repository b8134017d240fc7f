"""Record rates and errors over commits, and detect regressions.

    python bench/speed/history.py --backend opencl                 # measure, compare, append to bench/history.csv
    python bench/speed/history.py --compare                        # only compare the last commit with those before

Each row of the table is a call of one commit on one device: its time, its error, and whether the run was quiet. Calls
take turns with a probe, a sum of sines in NumPy. Times are processor time on a processor and elapsed time on a GPU;
short calls are timed several in a row, for at least 100 ms. Other programs only lengthen a call, so its lower quartile
counts: a call is quiet where the median is within 5 % of it, and is measured again, up to --tries times, where it is
not. The last commit is compared with the median of up to --window quiet rows before it, after processors' times are
corrected by the probe's: slower by more than 10 % (--limit), or an error twice as large, is a regression, and the exit
code 1. An older tree is measured with PYTHONPATH=TREE and --commit.
"""

from __future__ import annotations

import argparse
import csv
import math
import statistics
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import gpusense as gs
from gpusense.backends import Backend, get_backend
from gpusense.evaluation.machine import processor_name
from gpusense.evaluation.worlds import cloud_around, simulate_scan

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import ROOT, make_parser, note, parse, stated_commit

FILE = ROOT / "bench" / "history.csv"
COLUMNS = ("date", "commit", "device", "row", "ms", "q1_ms", "q3_ms", "probe_ms", "error", "unit", "quiet")
QUIET, LIMIT, WORSE = 0.05, 0.10, 2.0
# Least duration of a timing [s], and most calls of one.
SPAN, MOST = 0.1, 1000
# Errors below these are rounding, by their unit.
FLOORS = {"m": 1e-4, "nats": 1e-3}
Row = Mapping[str, str]
Call = tuple[Callable[[], Any], str, Callable[[], float]]


def calls_of(device: Backend, particles: int, beams: int) -> dict[str, Call]:
    """Return the calls with the units of their errors, and functions that compute these errors."""
    rng, grid = np.random.default_rng(0), gs.worlds.building(1, (40.0, 40.0))
    scanner = gs.Scanner(np.linspace(-np.pi, np.pi, beams, endpoint=False), 30.0)
    pose = np.array(gs.worlds.free_pose(grid, rng, 0.5))
    ranges = simulate_scan(grid, scanner, pose, gs.BeamParameters(), rng, "numpy")
    poses = cloud_around(pose, particles, 0.3, 0.1, rng)
    few, found = poses[:50], {}

    def add(name: str, unit: str, make: Callable[..., Any], call: Callable[[Any, Any], Any]) -> None:
        ours = make(backend=device, precision="float32")

        def error() -> float:
            right = call(make(backend="numpy", precision="float64"), few)
            # Rays that graze a corner have errors beyond rounding: the 95 % quantile leaves them out.
            return float(np.quantile(np.abs(np.asarray(call(ours, few), np.float64) - right), 0.95))

        found[name] = (lambda: call(ours, poses), unit, error)

    size = f"{particles} x {beams}"
    add(f"rays, {size}", "m", lambda **o: gs.RayCaster(grid, 30.0, **o), lambda m, x: m.cast(x, scanner.bearings))
    add(f"beam model, {size}", "nats", lambda **o: gs.BeamModel(grid, scanner, **o),
        lambda m, x: m.log_likelihood(x, ranges))  # fmt: skip
    add(f"field, {size}", "nats", lambda **o: gs.LikelihoodFieldModel(grid, scanner, **o),
        lambda m, x: m.log_likelihood(x, ranges))  # fmt: skip
    return found


def probe() -> float:
    """Sum sines: work that does not depend on the package."""
    return float(np.sin(np.arange(200_000, dtype=np.float64)).sum())


def timed(works: Mapping[str, Callable[[], Any]], turns: int, clock: Callable[[], float]) -> dict[str, list[float]]:
    """Return the times of calls that take turns [ms]."""
    times: dict[str, list[float]] = {name: [] for name in works}
    counts = dict.fromkeys(works, 1)
    for turn in range(-2, turns):
        for name, work in works.items():
            begin = clock()
            for _ in range(counts[name]):
                work()
            seconds = clock() - begin
            if turn == -1:
                counts[name] = math.ceil(SPAN / max(seconds, SPAN / MOST))
            elif turn >= 0:
                times[name].append(1e3 * seconds / counts[name])
    return times


def measure(backend: str, particles: int, beams: int, turns: int, tries: int, stated: str) -> list[dict[str, str]]:
    """Measure all calls in turns with the probe; return the rows. Calls that were not quiet are measured again."""
    device = get_backend(backend)
    clock = time.perf_counter if device.info.kind == "gpu" else time.process_time
    calls, rows = calls_of(device, particles, beams), dict[str, dict[str, str]]()
    where = device.info.name if device.info.kind == "gpu" else processor_name()
    for _ in range(tries):
        left = {name: call for name, (call, *_) in calls.items() if rows.get(name, {}).get("quiet") != "yes"}
        times = timed({"probe": probe} | left, turns, clock)
        for name in left:
            _, unit, error = calls[name]
            q1, median, q3 = np.quantile(times[name], (0.25, 0.5, 0.75))
            values = (
                time.strftime("%Y-%m-%d"), stated, f"{where}, {device.info.backend}", name, f"{median:.4g}",
                f"{q1:.4g}", f"{q3:.4g}", f"{statistics.median(times['probe']):.4g}", f"{error():.3g}", unit,
                "yes" if median <= (1 + QUIET) * q1 else "no",
            )  # fmt: skip
            rows[name] = dict(zip(COLUMNS, values, strict=True))
            note(", ".join(values))
        if all(row["quiet"] == "yes" for row in rows.values()):
            break
    return list(rows.values())


def read(file: Path) -> list[dict[str, str]]:
    """Read the table; an absent file is an empty one.

    Raises:
        ValueError: the file has other columns.
    """
    if not file.is_file():
        return []
    with file.open(newline="", encoding="utf-8") as stream:
        reader = csv.DictReader(stream)
        rows = list(reader)
        if tuple(reader.fieldnames or ()) != COLUMNS:
            raise ValueError(f"{file.name}: must have the columns {', '.join(COLUMNS)}, got {reader.fieldnames}")
    return rows


def append(file: Path, rows: Sequence[Row]) -> None:
    """Append rows to the table, with a head where it is new."""
    new = not file.is_file()
    with file.open("a", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, COLUMNS, lineterminator="\n")
        if new:
            writer.writeheader()
        writer.writerows(rows)


def regressions(rows: Sequence[Row], *, limit: float = LIMIT, window: int = 5) -> list[str]:
    """Compare the last row of each call on each device with quiet rows of other commits before it.

    Args:
        rows: Rows of the table in their order.
        limit: Growth of the time above which a call is slower; times of rows that are not quiet are not compared.
        window: The most rows that a row is compared with.

    Returns:
        A line for each regression.
    """
    found = []
    for key in dict.fromkeys((row["device"], row["row"]) for row in rows):
        own = [row for row in rows if (row["device"], row["row"]) == key]
        last, before = own[-1], [row for row in own if row["commit"] != own[-1]["commit"]][-window:]
        words = f"{last['row']} on {last['device']}, {last['commit']}"
        quiet = [row for row in before if row["quiet"] == "yes"]
        if quiet and last["quiet"] == "yes":
            growth = _relative(last) / statistics.median(map(_relative, quiet))
            if growth > 1 + limit:
                found.append(f"{words}: {growth:.2f} times the time of {len(quiet)} quiet runs before")
        if before:
            error, floor = statistics.median(float(row["error"]) for row in before), FLOORS[last["unit"]]
            if float(last["error"]) > WORSE * max(error, floor):
                found.append(f"{words}: error {last['error']} {last['unit']}, before {error:.3g}")
    return found


def _relative(row: Row) -> float:
    """Return the time of a row, of a processor in units of the probe."""
    return float(row["q1_ms"]) / (1.0 if "NVIDIA" in row["device"] else float(row["probe_ms"]))


def main() -> int:
    """Measure, append and compare."""
    parser = make_parser(__doc__, backend="auto")
    parser.add_argument("--file", type=Path, default=FILE, help="the table (default: bench/history.csv)")
    parser.add_argument("--compare", action="store_true", help="measure nothing")
    parser.add_argument("--limit", type=float, default=LIMIT, help="growth of a time (default: %(default)s)")
    parser.add_argument("--window", type=int, default=5, help="rows to compare with (default: %(default)s)")
    parser.add_argument("--turns", type=int, default=60, help="timed calls (default: %(default)s)")
    parser.add_argument("--tries", type=int, default=4, help="most measurements of a call (default: %(default)s)")
    parser.add_argument("--size", type=int, nargs=2, default=(10_000, 60), metavar=("PARTICLES", "BEAMS"))
    arguments: argparse.Namespace = parse(parser)
    if not arguments.compare:
        stated = stated_commit(parser, arguments)
        append(arguments.file, measure(arguments.backend, *arguments.size, arguments.turns, arguments.tries, stated))
    try:
        found = regressions(read(arguments.file), limit=arguments.limit, window=arguments.window)
    except ValueError as error:
        parser.error(str(error))
    print("\n".join(found or ["no regression"]))
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main())
