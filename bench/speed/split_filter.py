"""Measure where splitting a filter over several devices pays, and compare its particles with those of one device.

    python bench/speed/split_filter.py --device opencl --output bench/results/split_filter_cpu
    python bench/speed/split_filter.py --device warp:cuda:0 --device warp:cuda:1 --size 1000000 1080 --model beam

The first device has the single filter, all devices have the split one. The scene is a generated building with the cloud
of a tracked robot. A step is predict, correct, mean and covariance; both filters make the same steps in turns.
"""

from __future__ import annotations

import sys
import time
from functools import partial
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from common import make_parser, middle_pose, note, parse, publish, table

import gpusense as gs
from gpusense.evaluation.worlds import building

SIZES = ((2000, 60), (20_000, 180), (100_000, 360))


def make(beams: int, kind: str, device: str) -> Any:
    """Return the model of a device."""
    scanner = gs.Scanner.uniform(angle_min=-np.pi / 2, angle_increment=np.pi / (beams - 1), count=beams, range_max=20.0)
    if kind == "beam":
        return gs.BeamModel(building(), scanner, gs.BeamParameters(), backend=device)
    return gs.LikelihoodFieldModel(building(), scanner, gs.LikelihoodFieldParameters(sigma_hit=0.1), backend=device)


def filters(arguments: Any, particles: int, beams: int, stages: int) -> dict[str, gs.ParticleFilter]:
    """Return a filter on the first device, and one on all."""
    models = partial(make, beams, arguments.model)
    options = dict(particles=particles, temperature=0.2, stages=stages, seed=1)
    return {
        "one": gs.ParticleFilter(models(arguments.device[0]), **options),
        "split": gs.sweep.SplitParticleFilter(models, devices=arguments.device, **options),
    }


def measure(arguments: Any, particles: int, beams: int, stages: int) -> dict[str, Any]:
    """Return the milliseconds of a step of both filters, and whether their particles are equal."""
    grid = building()
    pose = middle_pose(grid)
    bearings = np.linspace(-np.pi / 2, np.pi / 2, beams)
    ranges = gs.RayCaster(grid, range_max=20.0, backend=arguments.device[0]).cast(pose[None], bearings)[0]
    both = filters(arguments, particles, beams, stages)
    times: dict[str, list[float]] = {name: [] for name in both}
    means: dict[str, np.ndarray] = {}
    for pf in both.values():
        pf.initialize(mean=pose, covariance=np.diag([0.01, 0.01, 0.002]))
    for _ in range(arguments.steps + 3):
        for name, pf in both.items():
            begin = time.perf_counter()
            pf.predict((0, 0, 0), (0, 0, 0))
            pf.correct(ranges)
            means[name] = pf.mean_and_covariance()[0]
            times[name].append((time.perf_counter() - begin) * 1000)
    ms = {name: float(np.median(each[3:])) for name, each in times.items()}
    equal = np.array_equal(both["one"].host_particles(), both["split"].host_particles())
    exchanged = both["split"].exchanged / (arguments.steps + 3)  # type: ignore[attr-defined]
    return dict(
        particles=particles, beams=beams, stages=stages, one_ms=ms["one"], split_ms=ms["split"],
        times=ms["one"] / ms["split"], equal=bool(equal), difference=float(np.abs(means["one"] - means["split"]).max()),
        exchanged_mb=exchanged / 1e6,
    )  # fmt: skip


def main() -> int:
    """Measure and write."""
    parser = make_parser(__doc__, backend="")
    parser.add_argument("--device", action="append", help="repeatable (default: opencl twice)")
    parser.add_argument("--model", choices=("field", "beam"), default="field")
    parser.add_argument("--size", type=int, nargs=2, action="append", metavar=("PARTICLES", "BEAMS"), help="repeatable")
    parser.add_argument("--stages", type=int, nargs="+", default=[1, 4])
    parser.add_argument("--steps", type=int, default=20)
    arguments = parse(parser)
    arguments.device = arguments.device or ["opencl", "opencl"]
    rows = []
    for particles, beams in arguments.size or SIZES:
        for stages in arguments.stages:
            rows.append(measure(arguments, particles, beams, stages))
            row = rows[-1]
            note(f"{particles} x {beams}, {stages}: {row['one_ms']:.2f}, {row['split_ms']:.2f} ms, {row['equal']}")
    columns = ("particles x beams", "stages", "one [ms]", "split [ms]", "times", "equal", "exchanged [MB a step]")
    lines = [
        (f"{row['particles']} x {row['beams']}", row["stages"], f"{row['one_ms']:.2f}", f"{row['split_ms']:.2f}",
         f"{row['times']:.2f}", "bits" if row["equal"] else f"mean within {row['difference']:.1e}",
         f"{row['exchanged_mb']:.2f}")
        for row in rows
    ]  # fmt: skip
    remark = f"{arguments.model}, split over {', '.join(arguments.device)}; medians of {arguments.steps} steps."
    publish(__file__, arguments, table(columns, lines), {"rows": rows}, remark)
    return 0


if __name__ == "__main__":
    sys.exit(main())
