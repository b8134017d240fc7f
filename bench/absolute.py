"""Speed and error of position fixes, headings, ranges to beacons and bumpers on the devices of this machine.

    python bench/absolute.py                                        # every device present
    python bench/absolute.py --backend opencl --particles 100000 --output bench/results/name

Writes a Markdown table and a JSON file with machine, sizes, times, errors and the command. Poses are all over the
built-in building, moved to UTM coordinates. A reading is a fix, a heading, a range, or a segment of a bumper. Rates
are of whole calls with NumPy in and out, and of their launches alone. Errors are of log p against the float64 reference
on the first particles, in eps (1 + |log p|) of float32 and a reading.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from speed import Recorder, best, publish

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.evaluation.worlds import building, cloud_uniform

CHECKED = 200
# Where the building stands [m]: a place of UTM's.
PLACE = (5e5, 5e6, 0.3)
SQUARE = [(0.2, 0.2), (-0.2, 0.2), (-0.2, -0.2), (0.2, -0.2)]


def sensors(grid: gs.OccupancyGrid, xy: np.ndarray) -> dict[str, tuple[Callable[..., Any], tuple[Any, ...], int]]:
    """What makes each model, what it is given, and how many readings these are."""
    x, y = float(xy[0, 0]), float(xy[0, 1])
    region = (x - 500, y - 500, x + 500, y + 500)
    ranges = np.full(len(xy), 12.0)
    found: dict[str, tuple[Callable[..., Any], tuple[Any, ...], int]] = {
        "position fix": (lambda **own: gs.PositionModel(gs.PositionParameters(sigma=2.0), **own), ((x, y),), 1),
        "position fix, outliers and mount": (
            lambda **own: gs.PositionModel(
                gs.PositionParameters(sigma=2.0, z_hit=0.9, z_rand=0.1, region=region, mount=(0.2, 0.1)), **own
            ),
            ((x, y),),
            1,
        ),
        "heading, wrapped normal": (lambda **own: gs.HeadingModel(gs.HeadingParameters(sigma=0.1), **own), (1.0,), 1),
        "heading, von Mises and outliers": (
            lambda **own: gs.HeadingModel(gs.HeadingParameters(kind="von_mises", z_hit=0.9, z_rand=0.1), **own),
            (1.0,),
            1,
        ),
    }
    for kind in ("normal", "student_t", "mixture"):
        p = gs.BeaconParameters(kind=kind, range_max=100.0)
        found[f"beacons, {kind}"] = (lambda p=p, **own: gs.BeaconModel(xy, p, **own), (ranges,), len(xy))
    found["bumper, circle"] = (lambda **own: gs.BumperModel(grid, 0.25, **own), (True,), 1)
    found["bumper, square of 4 segments"] = (
        lambda **own: gs.BumperModel(grid, SQUARE, segments=[0, 1, 2, 3], **own),
        ([True, False, False, False],),
        4,
    )
    return found


def row_of(
    backend: str, name: str, make: Callable[..., Any], measured: tuple[Any, ...], readings: int, poses: np.ndarray,
    arguments: argparse.Namespace,
) -> dict[str, Any]:  # fmt: skip
    """Times and error of one sensor on a device.

    Raises:
        RuntimeError: the error is above 16 eps (1 + |log p|), so no time counts.
    """
    device = Recorder(get_backend(backend))
    start = time.perf_counter()
    model = make(backend=device)
    found = model.log_likelihood(poses, *measured)
    first = time.perf_counter() - start
    launches = device.launches_of(lambda: model.log_likelihood(poses, *measured))

    def again() -> None:
        for launch in launches:
            launch()
        device.synchronize()

    least, median = best(lambda: model.log_likelihood(poses, *measured), arguments.repeats, arguments.seconds)
    alone, _ = best(again, arguments.repeats, arguments.seconds)
    exact = make(backend="numpy", precision="float64").log_likelihood(poses[:CHECKED], *measured)
    size = readings * np.finfo(np.float32).eps * (1 + np.abs(exact) / readings)
    error = float(np.max(np.abs(found[:CHECKED] - exact) / size))
    if not error < 16:
        raise RuntimeError(f"{backend}, {name}: the error is {error:.3g} eps (1 + |log p|), so no time counts")
    return {
        "backend": device.info.selection, "device": device.info.name, "what": name, "particles": len(poses),
        "readings": readings, "first_s": first, "steady_s": least, "median_s": median,
        "rate": len(poses) * readings / least, "launches": len(launches), "launch_s": alone,
        "launch_rate": len(poses) * readings / alone, "error": error,
    }  # fmt: skip


def to_markdown(rows: list[dict[str, Any]]) -> str:
    """The rows as a table."""
    head = (
        "| backend | device | what | particles x readings | M particle-readings/s | launches alone "
        "| ms a call (median) | first call s | error, eps (1 + \\|log p\\|) |\n|" + " --- |" * 9
    )
    lines = [
        f"| {r['backend']} | {r['device']} | {r['what']} | {r['particles']} x {r['readings']} | {r['rate'] / 1e6:.4g} "
        f"| {r['launch_rate'] / 1e6:.4g} | {r['steady_s'] * 1e3:.3g} ({r['median_s'] * 1e3:.3g}) | {r['first_s']:.2f} "
        f"| {r['error']:.2f} |"
        for r in rows
    ]
    return "\n".join([head, *lines])


def main() -> int:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backend", action="append", help="selection string; every device present where left out")
    parser.add_argument("--particles", type=int, default=100_000)
    parser.add_argument("--beacons", type=int, default=8)
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=2.0, help="longest time of the repeats of one row")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--commit", default="", help="for a copy of the tree that is no git repository")
    parser.add_argument("--output", type=Path, help="path without ending for the .json and .md files")
    arguments = parser.parse_args()
    rng = np.random.default_rng(arguments.seed)
    flat = building(arguments.seed)
    grid = gs.OccupancyGrid(flat.cells, flat.resolution, origin=PLACE)
    poses = cloud_uniform(grid, arguments.particles, rng)
    xy = poses[0, :2] + rng.uniform(-20, 20, (arguments.beacons, 2))
    present = [d.selection for d in gs.devices() if d.available and d.kind != "simulator"]
    rows = [
        row_of(backend, name, *how, poses, arguments)
        for backend in arguments.backend or present
        for name, how in sensors(grid, xy).items()
    ]
    publish("absolute.py", arguments, to_markdown(rows), {"rows": rows})
    return 0


if __name__ == "__main__":
    sys.exit(main())
