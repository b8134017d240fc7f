"""The verdict on short logs in small worlds: how often "tracking" is wrong, by the number of scans.

Every second log is of another building than the map. Two of three filters begin anywhere, the others at the first pose,
or, in the map of another building, around a free pose. Buildings have sides of 10 to 24 m, scanners 60 to 360 beams and
ranges up to 8, 12 or 20 m; the robot goes 2 to 20 cm a scan. A pose is wrong off by 1 m or 0.5 rad, or on another map.

    python bench/studies/verdict_short.py --seconds 300 --out verdict_short.json
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import recordings
import verdict_runs as runs

import gpusense as gs
from gpusense._util.progress import progress
from gpusense.evaluation.machine import machine, machine_line

SCANS = (10, 20, 30, 40, 60)
KINDS = ("anywhere", "at a pose")
# Errors beyond which a pose is wrong [m, rad].
FAR, FAR_TURN = 1.0, 0.5


def follow(seed, backend):
    """Return the kind of the start, and p_lost, whether tracked and whether wrong, after each number of ``SCANS``."""
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
    pf = gs.ParticleFilter(
        recordings.field(backend, beams=60)(grid, scanner), particles=2000 if start == "anywhere" else 500, seed=seed
    )
    if start == "anywhere":
        pf.initialize_uniform()
    else:
        mean = gs.worlds.free_pose(grid, rng, 0.2) if other else run.poses[0]
        pf.initialize(mean=mean, covariance=np.diag(np.square(runs.START)))
    rows = []
    for k in range(max(SCANS)):
        if k:
            pf.predict(run.odometry[k - 1], run.odometry[k])
        pf.correct(run.scans[k])
        e = pf.estimate()
        d = e.pose - run.poses[k]
        wrong = other or math.hypot(d[0], d[1]) > FAR or abs(math.remainder(d[2], math.tau)) > FAR_TURN
        if k + 1 in SCANS:
            rows.append((e.p_lost, e.verdict == "tracking", wrong))
    return start, np.array(rows, np.float64)


def table(found):
    """Return the lines of the table."""
    lines = ["| start | scans | runs | tracked | of them wrong | said [%] | right | of them tracked |",
             "| --- | --- | --- | --- | --- | --- | --- | --- |"]  # fmt: skip
    for kind in KINDS:
        rows = np.array([each for start, each in found if start == kind])
        for k, scans in enumerate(SCANS):
            if not len(rows):
                continue
            p, tracked, wrong = rows[:, k].T
            tracked, wrong = tracked > 0, wrong > 0
            said = 100 * p[tracked].mean() if tracked.any() else math.nan
            lines.append(f"| {kind} | {scans} | {len(rows)} | {tracked.sum()} | {(tracked & wrong).sum()} | {said:.1f} "
                         f"| {(~wrong).sum()} | {(tracked & ~wrong).sum()} |")  # fmt: skip
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backend", default="opencl")
    parser.add_argument("--runs", type=int, default=120)
    parser.add_argument("--first", type=int, default=5000, help="first seed; constants were chosen below 2000")
    parser.add_argument("--seconds", type=float, default=math.inf, help="begin no more runs after this time")
    parser.add_argument("--out", type=Path, help="a .json file; the table goes to the .md file beside it")
    args = parser.parse_args()
    found, begin = [], time.time()
    with progress(args.runs) as step:
        for seed in range(args.first, args.first + args.runs):
            if time.time() - begin > args.seconds:
                break
            step(f"run {seed}")
            found.append(follow(seed, args.backend))
    lines = table(found)
    print("\n".join(lines))
    if args.out is not None:
        command = " ".join(["bench/studies/verdict_short.py", *sys.argv[1:]])
        results = [dict(start=start, rows=rows.tolist()) for start, rows in found]
        args.out.write_text(json.dumps(dict(machine=machine(), command=command, results=results), indent=1))
        text = "\n".join(lines)
        args.out.with_suffix(".md").write_text(f"{machine_line()}\n\n`python {command}`\n\n{text}\n")


if __name__ == "__main__":
    main()
