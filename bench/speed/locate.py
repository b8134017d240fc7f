"""Time locate_scan: medians and slowest of single scans on maps of three sizes, and scans a second in batches.

    python bench/speed/locate.py --backend opencl --backend warp:cuda:0 --output bench/results/locate_name
    python bench/speed/locate.py --recorded DATA --scans 40

Scans of 360 beams with noise, people and lost returns are drawn at poses all over a built-in building of 20, 50 and
100 m a side, with cells of 5 cm. With ``--recorded``, odd scans of two logs in the maps of their even scans, and in the
map of the other building. Each figure is the least of ``--repeats`` calls of a scan, so that other work on the machine
counts little; times of the processor add all threads.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

import gpusense as gs
from gpusense.evaluation.worlds import building, cloud_uniform

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import make_parser, note, odd_scans, parse, publish, table

SIDES = (20.0, 50.0, 100.0)
BEAMS = 360
COLUMNS = ("device", "scans of", "map", "cells", "scans", "median ms", "95 % ms", "slowest ms", "processor, median ms",
           "batch", "batch, scans a second", "batch, processor, ms a scan", "as single calls")  # fmt: skip


def measure(model: gs.LikelihoodFieldModel, scans: np.ndarray, repeats: int, batch: int) -> dict[str, Any]:
    """Return the times of single scans [ms], and the rate of one call with many."""
    gs.locate_scan(model, scans[0])
    times, alone = [], []
    for scan in scans:
        least = [np.inf, np.inf]
        for _ in range(repeats):
            begin = time.perf_counter(), time.process_time()
            found = gs.locate_scan(model, scan)
            end = time.perf_counter(), time.process_time()
            least = [min(before, 1e3 * (b - a)) for before, a, b in zip(least, begin, end, strict=True)]
        times.append(least)
        alone.append(found)
    wall, processor = np.array(times).T
    row = {"median ms": np.median(wall), "95 % ms": np.quantile(wall, 0.95), "slowest ms": wall.max(),
           "processor, median ms": np.median(processor)}  # fmt: skip
    if batch:
        together = np.resize(scans, (batch, scans.shape[1]))
        found = gs.locate_scan(model, together)
        seconds, busy = [], []
        for _ in range(max(repeats, 2)):
            begin = time.perf_counter(), time.process_time()
            found = gs.locate_scan(model, together)
            seconds.append(time.perf_counter() - begin[0])
            busy.append(time.process_time() - begin[1])
        same = all((found[i].pose == alone[i % len(scans)].pose).all() for i in range(batch))
        row |= {"batch": batch, "batch, scans a second": batch / min(seconds),
                "batch, processor, ms a scan": 1e3 * min(busy) / batch, "as single calls": same}  # fmt: skip
    return row


def drawn(expected: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draw scans: expected ranges with noise of 3 cm, a tenth of the beams cut short, a fiftieth without a return."""
    ranges = expected + rng.normal(0, 0.03, expected.shape)
    ranges = np.where(rng.random(expected.shape) < 0.1, ranges * rng.random(expected.shape), ranges)
    return np.where(rng.random(expected.shape) < 0.02, np.inf, np.maximum(ranges, 0.05))


def built_in(backend: str, arguments: Any) -> list[dict[str, Any]]:
    """Locate simulated scans in buildings of three sizes."""
    rows = []
    scanner = gs.Scanner(np.linspace(-np.pi, np.pi, BEAMS, endpoint=False), 30.0)
    for side in arguments.side or SIDES:
        grid, rng = building(0, (side, side)), np.random.default_rng(1)
        poses = cloud_uniform(grid, arguments.scans, rng)
        model = gs.LikelihoodFieldModel(grid, scanner, backend=backend)
        scans = drawn(gs.RayCaster(grid, scanner.range_max, backend=backend).cast(poses, scanner.bearings), rng)
        size = " x ".join(map(str, grid.shape))
        rows.append({"scans of": "building", "map": f"{side:g} m", "cells": size, "scans": len(scans)}
                    | measure(model, scans, arguments.repeats, arguments.batch))  # fmt: skip
        note(f"{backend} {size}")
    return rows


def recorded(backend: str, arguments: Any) -> list[dict[str, Any]]:
    """Locate recorded scans in their map and in the map of another building."""
    rows = []
    for log, place in (("intel", "intel"), ("csail", "csail"), ("intel", "csail"), ("csail", "intel")):
        grid, _ = odd_scans(arguments.recorded, place)
        _, scans = odd_scans(arguments.recorded, log)
        chosen = [scans[i * len(scans) // arguments.scans][1] for i in range(arguments.scans)]
        model = gs.LikelihoodFieldModel(grid, chosen[0].scanner, backend=backend, beams=180)
        size = " x ".join(map(str, grid.shape))
        rows.append({"scans of": log, "map": place, "cells": size, "scans": len(chosen)}
                    | measure(model, np.array([scan.ranges for scan in chosen]), arguments.repeats,
                              arguments.batch if log == place else 0))  # fmt: skip
        note(f"{backend} {log} in {place}")
    return rows


def shown(value: Any) -> str:
    """Format a figure."""
    return f"{value:.4g}" if isinstance(value, float) else "-" if value is None else str(value)


def main() -> int:
    """Measure and write."""
    parser = make_parser(__doc__, backend="kernels")
    parser.add_argument("--recorded", type=Path, metavar="DATA", help="folder of recorded data; default: the building")
    parser.add_argument("--scans", type=int, default=12, help="of each map (default: %(default)s)")
    parser.add_argument("--side", type=float, action="append", help="of the building [m] (default: 20, 50 and 100)")
    parser.add_argument("--repeats", type=int, default=3, help="of each scan (default: %(default)s)")
    parser.add_argument("--batch", type=int, default=64, help="scans of one call; 0: none (default: %(default)s)")
    arguments = parse(parser)
    make = recorded if arguments.recorded else built_in
    rows = [{"device": backend} | row for backend in arguments.backend for row in make(backend, arguments)]
    text = table(COLUMNS, [[shown(row.get(name)) for name in COLUMNS] for row in rows])
    plain = [{key: value.item() if hasattr(value, "item") else value for key, value in row.items()} for row in rows]
    publish(__file__, arguments, text, {"rows": plain})
    return 0


if __name__ == "__main__":
    sys.exit(main())
