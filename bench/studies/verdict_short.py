"""The verdict on short logs in small worlds: how often "tracking" is wrong, by the number of scans.

Every second log comes from another building than the map. Two of three filters begin anywhere, the other ones at the
first pose, or around a free pose where the building is another one. Buildings have sides of 10 to 24 m, scanners 60 to
360 beams and ranges up to 8, 12 or 20 m; the robot goes 2 to 20 cm a scan. A pose is wrong with an error above 1 m or
0.5 rad, or on the map of another building.

    python bench/studies/verdict_short.py --seconds 300 --output verdict_short
"""

from __future__ import annotations

import math
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import recordings
from common import make_parser, parse, publish, table

import gpusense as gs
from gpusense._util.progress import progress

SCANS = (10, 20, 30, 40, 60)
KINDS = ("anywhere", "at a pose")
# Errors beyond which a pose is wrong [m, rad].
FAR, FAR_TURN = 1.0, 0.5


def follow(seed, backend):
    """Return the kind of the start, and p_lost, whether "tracking" and whether wrong after each number of ``SCANS``."""
    rng = np.random.default_rng((31, seed))
    other, start = seed % 2 == 1, KINDS[int(seed // 2 % 3 == 2)]

    def building(number):
        return gs.worlds.building(seed=number, size=(float(rng.uniform(10, 24)), float(rng.uniform(10, 18))))

    grid, span, beams = building(10_000 + seed), float(rng.choice([1.5, 2])) * math.pi, int(rng.choice([60, 120, 360]))
    scanner = gs.Scanner.uniform(
        angle_min=-span / 2, angle_increment=span / beams, count=beams, range_max=float(rng.choice([8, 12, 20]))
    )
    moved = float(rng.choice([0, 0, 0.1]))
    world = dict(world=building(900_000 + seed)) if other else dict(moved=moved, added=moved / 3)
    run = gs.worlds.simulate_run(
        grid, scanner, scans=max(SCANS), hidden=float(rng.choice([0, 0, 0.1])),
        step=float(rng.choice([0.02, 0.05, 0.1, 0.2])), seed=seed, backend="numpy", **world,
    )  # fmt: skip
    models = [recordings.field(backend, beams=60)(grid, scanner)]
    pf = gs.ParticleFilter(models, particles=2000 if start == "anywhere" else 500, seed=seed)
    at = gs.worlds.free_pose(grid, rng, 0.2) if other and start != "anywhere" else run.poses[0]
    recordings.start_at(pf, None if start == "anywhere" else at)
    rows = []
    for k, event in enumerate(recordings.play(pf, models, recordings.simulated_events(run))):
        e = pf.estimate()
        distance, turn = recordings.errors(e.pose, event.truth)
        wrong = other or distance > FAR or turn > FAR_TURN
        if k + 1 in SCANS:
            rows.append((e.p_lost, e.verdict == "tracking", wrong))
    return start, np.array(rows, np.float64)


COLUMNS = ("start", "scans", "runs", "tracked", "of them wrong", "said [%]", "right", "of them tracked")


def cells(found):
    """Yield the cells of each row of the table."""
    for kind in KINDS:
        rows = np.array([each for start, each in found if start == kind])
        for k, scans in enumerate(SCANS if len(rows) else ()):
            p, tracked, wrong = rows[:, k].T
            tracked, wrong = tracked > 0, wrong > 0
            said = 100 * p[tracked].mean() if tracked.any() else math.nan
            yield (kind, scans, len(rows), tracked.sum(), (tracked & wrong).sum(), f"{said:.1f}", (~wrong).sum(),
                   (tracked & ~wrong).sum())  # fmt: skip


def main() -> None:
    parser = make_parser(__doc__, backend="opencl", seed=False)
    parser.add_argument("--runs", type=int, default=120)
    parser.add_argument("--first", type=int, default=5000, help="first seed; constants were chosen below 2000")
    parser.add_argument("--seconds", type=float, default=math.inf, help="begin no more runs after this time")
    args = parse(parser)
    found, begin = [], time.time()
    with progress(args.runs) as step:
        for seed in range(args.first, args.first + args.runs):
            if time.time() - begin > args.seconds:
                break
            step(f"run {seed}")
            found.append(follow(seed, args.backend))
    results = [dict(start=start, rows=rows.tolist()) for start, rows in found]
    publish(__file__, args, table(COLUMNS, cells(found)), dict(results=results))


if __name__ == "__main__":
    main()
