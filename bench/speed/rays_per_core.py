"""Compare casters with range_libc's in turns on the same poses: rays per second of processor time.

    RANGE_LIBC=SOURCES python bench/speed/rays_per_core.py --backend opencl

range_libc runs one thread, so the process's processor times are compared, not elapsed ones: the rate of a core. A busy
machine changes them little. The map is the built-in building; poses lie around one place (tracking) or all over the map
(global). Tables have the same angle bins on both sides, marching the same steps (``rule="centre"``). Medians of
differences of ranges are between the two.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import gpusense as gs
from gpusense.evaluation.worlds import building, cloud_around, cloud_uniform, free_pose

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import add_repeats, make_parser, note, parse, publish, table, table_line
from speed import range_libc

BEARINGS, RANGE_MAX = np.linspace(-2.35, 2.35, 360), 15.0
# range_libc's method, its angle bins, and the caster.
PAIRS = (
    ("GLT", 108, gs.casters.Lookup(108)),
    ("CDDT", 108, gs.casters.Cddt(108)),
    ("RM", 0, gs.casters.March(rule="centre")),
)
COLUMNS = ("backend", "caster", "cloud", "M rays/s a core", "range_libc", "ratio", "median difference [m]")


def least(ways: list[Callable[[], Any]], repeats: int, seconds: float) -> list[float]:
    """Return the least processor time of each way, measured in turns [s]."""
    found, begin = [float("inf")] * len(ways), time.perf_counter()
    for _ in range(repeats):
        for k, way in enumerate(ways):
            before = time.process_time()
            way()
            found[k] = min(found[k], time.process_time() - before)
        if time.perf_counter() - begin > seconds * len(ways):
            break
    return found


def measure(library: Any, backend: str, particles: int, repeats: int, seconds: float) -> list[dict[str, Any]]:
    """Measure every caster on both clouds."""
    rng, grid = np.random.default_rng(0), building(0)
    around = cloud_around(free_pose(grid, rng), particles, 0.3, 0.1, rng)
    clouds = {"tracking": around, "global": cloud_uniform(grid, particles, rng)}
    rows = []
    for kind, bins, method in PAIRS:
        other = range_libc.Caster(library, kind, grid.occupied, RANGE_MAX / grid.resolution, bins)
        caster = gs.RayCaster(grid, RANGE_MAX, caster=method, backend=backend)
        for cloud, poses in clouds.items():
            cells = np.column_stack([(poses[:, :2] - grid.origin[:2]) / grid.resolution, poses[:, 2]])
            apart = caster.cast(poses, BEARINGS) - other.cast(cells, BEARINGS) * grid.resolution
            ways = [lambda c=caster, p=poses: c.cast(p, BEARINGS), lambda o=other, p=cells: o.cast(p, BEARINGS)]
            mine, theirs = (apart.size / seconds for seconds in least(ways, repeats, seconds))
            rows.append({"backend": caster.device.selection, "caster": str(method), "cloud": cloud, "rate": mine,
                         "range_libc": theirs, "apart": float(np.median(np.abs(apart)))})  # fmt: skip
            note(table_line(cells_of(rows[-1])))
    return rows


def cells_of(row: dict[str, Any]) -> list[str]:
    """Format the cells of a row."""
    return [
        row["backend"], row["caster"], row["cloud"], f"{row['rate'] / 1e6:.4g}", f"{row['range_libc'] / 1e6:.4g}",
        f"{row['rate'] / row['range_libc']:.2f}", f"{row['apart']:.3f}",
    ]  # fmt: skip


def main() -> int:
    """Measure and write."""
    parser = make_parser(__doc__)
    parser.add_argument("--particles", type=int, default=8192)
    add_repeats(parser, 10, 3.0)
    arguments = parse(parser)
    library, missing = range_libc.load()
    if library is None:
        parser.error(f"range_libc: {missing}")
    rows = []
    for backend in arguments.backend:
        rows += measure(library, backend, arguments.particles, arguments.repeats, arguments.seconds)
    publish(__file__, arguments, table(COLUMNS, map(cells_of, rows)), {"rows": rows})
    return 0


if __name__ == "__main__":
    sys.exit(main())
