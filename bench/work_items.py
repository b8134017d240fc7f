"""How many work-items a launch is best split into: times of launches alone, for powers of two.

    python bench/work_items.py --backend opencl --backend warp:cuda:0 --power 19 --power 21 --output bench/results/name

Rows are of the built-in building of 2000 x 2000 cells, with a cloud over the whole map and one around a pose. "All" are
the launches of a call with its arrays on the device; "main" is the one that casts or looks up, four of them in a row.
Ways are taken in turns. GPUs split their launches by ``gpusense.models.cloud``; to processors the number means nothing.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from speed import Recorder, publish, scene_of

from gpusense.backends import get_backend
from gpusense.models import cloud
from gpusense.models.scan import field

AGAIN = 4


def seconds(device: Any, run: Callable[[], Any]) -> float:
    """Of one run, waited for."""
    device.synchronize()
    start = time.perf_counter()
    run()
    device.synchronize()
    return time.perf_counter() - start


def rows_of(backend: str, arguments: argparse.Namespace) -> list[dict[str, Any]]:
    """All rows of one device."""
    device, scene = get_backend(backend), scene_of(arguments)
    rows = []
    for name, poses in scene.clouds.items():
        for what in ("rays", "beam model", "field"):
            jobs = []
            for power in arguments.power:
                cloud._ENOUGH = field.ENOUGH_SHORT = 1 << power
                launches = scene.launches(Recorder(device), what, poses)
                jobs.append((power, launches, launches[-1 if what == "rays" or len(launches) == 2 else -2]))
            best = {power: [np.inf, np.inf] for power, *_ in jobs}
            for _ in range(arguments.repeats):
                for power, launches, main in jobs:
                    everything = seconds(device, lambda launches=launches: [launch() for launch in launches])
                    alone = seconds(device, lambda main=main: [main() for _ in range(AGAIN)]) / AGAIN
                    best[power] = [min(best[power][0], everything), min(best[power][1], alone)]
            for power, (everything, alone) in best.items():
                row = {"backend": device.info.selection, "device": device.info.name, "what": f"{what}, {name}"}
                rows.append(
                    {**row, "power": power, "all_s": everything, "main_s": alone, "work": len(poses) * arguments.beams}
                )
                print(to_markdown(rows[-1:]).splitlines()[-1], file=sys.stderr, flush=True)
    return rows


def to_markdown(rows: list[dict[str, Any]]) -> str:
    """The rows as a table."""
    lines = ["| backend | what | work-items | all, ms | M/s | main, ms | M/s |", "| --- " * 7 + "|"]
    for row in rows:
        times = " | ".join(f"{row[k] * 1e3:.3f} | {row['work'] / row[k] / 1e6:.4g}" for k in ("all_s", "main_s"))
        lines.append(f"| {row['backend']} | {row['what']} | 2^{row['power']} | {times} |")
    return "\n".join(lines)


def main() -> int:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backend", action="append", required=True, help="selection string; may be repeated")
    parser.add_argument("--power", action="append", type=int, help="of two, work-items; default: 19, 20, 21 and 22")
    parser.add_argument("--particles", type=int, default=100_000)
    parser.add_argument("--beams", type=int, default=360)
    parser.add_argument("--size", type=float, default=100.0, help="side of the built-in building in metres")
    parser.add_argument("--repeats", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--commit", default="", help="for a copy of the tree that is no git repository")
    parser.add_argument("--output", type=Path, help="path without ending for the .json and .md files")
    arguments = parser.parse_args()
    arguments.power = arguments.power or [19, 20, 21, 22]
    rows = [row for backend in arguments.backend for row in rows_of(backend, arguments)]
    sizes = f"Sizes: {arguments.particles} x {arguments.beams}."
    publish("work_items.py", arguments, to_markdown(rows), {"rows": rows}, sizes)
    return 0


if __name__ == "__main__":
    sys.exit(main())
