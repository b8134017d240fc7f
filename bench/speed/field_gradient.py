"""Measure the speed of the interpolated likelihood field's log p, gradient and information.

    python bench/speed/field_gradient.py --backend opencl --output NAME

Rows: poses all over a building, and around the scan's pose as in a match; one scan, and twenty scans in a call.
*Call* is the best whole call with NumPy arrays, *kernels* are its launches alone with a single wait. Look-ups are poses
times hits, in millions a second; *per processor second* divides by the time of all cores. Gradients of some poses are
checked against the NumPy reference in float64.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.evaluation.worlds import building, cloud_around, cloud_uniform, free_pose

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import Recorder, add_repeats, best, make_parser, one_by_one, parse, publish, table, waited

SCANS, CHECKED = 20, 50
# Largest difference of a gradient from the reference, relative to the largest gradient.
MOST_OFF = 1e-3


def measure(selection: str, poses: np.ndarray, ranges: np.ndarray, grid: Any, scanner: Any, options: Any) -> Any:
    """Return seconds of a call, of its launches, and of all cores in a call."""
    device, parameters = Recorder(get_backend(selection)), gs.LikelihoodFieldParameters(interpolation="bilinear")
    model = gs.LikelihoodFieldModel(grid, scanner, parameters, backend=device)  # type: ignore[arg-type]
    exact = gs.LikelihoodFieldModel(grid, scanner, parameters, backend="numpy", precision="float64")
    part = poses[..., :CHECKED, :]
    expected, found = exact.gradient(part, ranges)[1], model.gradient(part, ranges)[1]
    off = float(np.abs(found - expected).max() / np.abs(expected).max())
    if not off < MOST_OFF:
        raise RuntimeError(f"{selection}: the gradient is off by {off:.3g} of the largest, so no time counts")

    def call() -> None:
        model.gradient(poses, ranges)

    call()
    launches = device.launches_of(call)
    call()
    whole, _ = best(call, options.repeats, options.seconds)
    alone, _ = best(waited(device, one_by_one(launches)), options.repeats, options.seconds)
    used = np.inf
    for _ in range(3):
        begun = time.process_time()
        call()
        used = min(used, time.process_time() - begun)
    return whole, alone, used


def main(argv: list[str] | None = None) -> None:
    """Measure, and publish a table."""
    parser = make_parser(__doc__, backend="kernels")
    parser.add_argument("--particles", type=int, default=100_000, help="poses of a call (default: %(default)s)")
    parser.add_argument("--beams", type=int, default=360, help="readings of a scan (default: %(default)s)")
    add_repeats(parser, 10, 10.0)
    options = parse(parser, argv)
    grid, rng = building(options.seed), np.random.default_rng(options.seed)
    scanner = gs.Scanner.uniform(
        angle_min=-2.35, angle_increment=4.7 / (options.beams - 1), count=options.beams, range_max=30.0
    )
    pose, count = free_pose(grid, rng), options.particles // SCANS * SCANS
    ranges = gs.RayCaster(grid, 30.0, backend="numpy").cast(pose[None], scanner.bearings)[0].astype(np.float64)
    lookups = count * int((ranges < 30.0).sum())
    clouds = {"all over": cloud_uniform(grid, count, rng), "around": cloud_around(pose, count, 0.3, 0.1, rng)}
    rows: list[dict[str, Any]] = []
    for selection in options.backend:
        for name, poses in clouds.items():
            for scans in (1, SCANS):
                shaped = poses if scans == 1 else poses.reshape(scans, -1, 3)
                given = ranges if scans == 1 else np.tile(ranges, (scans, 1))
                whole, alone, used = measure(selection, shaped, given, grid, scanner, options)
                rows.append({
                    "backend": selection, "poses": name, "scans": scans, "count": count, "lookups": lookups,
                    "call_ms": 1e3 * whole, "kernels_ms": 1e3 * alone, "processor_ms": 1e3 * used,
                })  # fmt: skip
    lines = [
        [
            r["backend"], r["poses"], str(r["scans"]), f"{r['call_ms']:.2f}", f"{r['kernels_ms']:.2f}",
            *(f"{1e-3 * lookups / r[key]:.0f}" for key in ("call_ms", "kernels_ms", "processor_ms")),
        ]
        for r in rows
    ]  # fmt: skip
    columns = [
        "backend", "poses", "scans", "call ms", "kernels ms", "M look-ups/s, call", "M look-ups/s, kernels",
        "M look-ups per processor second",
    ]  # fmt: skip
    publish(__file__, options, table(columns, lines), {"rows": rows}, f"{count} poses, {options.beams} beams.")


if __name__ == "__main__":
    main()
