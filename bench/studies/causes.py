"""Confusion table of the likely cause: simulated runs with one cause each.

A filter at its defaults tracks each run from the true start, with a map, a laser and an odometry that have the cause.
In runs in which the robot is carried away the filter has no recovery, so that it stays lost. Poses among people, and on
a map that was moved since, are true poses with an error of a few centimetres, like those of another localiser.

    python bench/studies/causes.py --shard 1/2 --raw shard_1.npz
    python bench/studies/causes.py --join shard_*.npz --output causes
"""

from __future__ import annotations

import ast
import math
import sys
import time
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import recordings
import verdict_runs as runs
from common import make_parser, note, parse, publish, table

import gpusense as gs
from gpusense.evaluation.tracking import START
from gpusense.localization.pose_algebra import compose_poses, invert_poses, pose_difference
from gpusense.localization.run_causes import diagnose_run
from gpusense.localization.scan_motion import Moment

CAUSES = ("none", "people", "start", "moved", "mount", "mirrored", "map", "scale", "odometry", "time")
FOUND = (*CAUSES, "unknown")
COLUMNS = ("cause", "runs", *FOUND, "right [%]", "right or unknown [%]", "median ms")


def useless(odometry, rng):
    """Return an odometry that stands, runs twice as fast, drifts to the left, or has the steps of another time."""
    steps = pose_difference(odometry[:-1], odometry[1:])
    kind = int(rng.integers(4))
    if kind == 0:
        steps = steps * 0
    elif kind == 1:
        steps = steps * np.array([2.0, 2.0, 1.0])
    elif kind == 2:
        steps = steps + np.array([0.0, 0.0, 0.15])
    else:
        steps = rng.permutation(steps)
    poses = [odometry[0]]
    for step in steps:
        poses.append(compose_poses(poses[-1], step))
    return np.array(poses)


def late(odometry, times, delay):
    """Return the odometry of other times."""
    values = np.column_stack([odometry[:, :2], np.unwrap(odometry[:, 2])])
    return np.stack([np.interp(times - delay, times, values[:, k]) for k in range(3)], axis=1)


def made(cause, seed, scans, backend):
    """Return a map, a scanner, a run, its scans and odometry with a cause."""
    rng = np.random.default_rng((17, CAUSES.index(cause), seed))
    size = float(rng.uniform(18, 40)), float(rng.uniform(14, 30))
    grid = world = gs.worlds.building(seed=60_000 + seed, size=size)
    span, beams = math.radians(float(rng.choice([180, 240, 358]))), int(rng.choice([120, 180, 360]))
    bearings, mount = np.linspace(-span / 2, span / 2, beams), (float(rng.uniform(0, 0.4)), 0.0, 0.0)
    scanner = seen = gs.Scanner(bearings, range_max=20.0, mount=mount)
    if cause == "mount":
        angle = math.radians(float(rng.uniform(5, 30)) * rng.choice([-1, 1]))
        seen = gs.Scanner(bearings, range_max=20.0, mount=(*mount[:2], angle))
    elif cause == "map":
        grid = gs.worlds.building(seed=70_000 + seed, size=size)
    elif cause == "scale":
        scale = float(rng.choice([0.7, 0.8, 0.9, 1.1, 1.25, 1.4]))
        world = gs.OccupancyGrid(grid.cells, grid.resolution * scale, grid.origin)
    options = dict(scans=scans, seed=seed, backend=backend, kidnaps=int(cause == "start"))
    options["hidden"] = 0.3 if cause == "people" else float(rng.choice([0, 0.1]))
    run = gs.worlds.simulate_run(world, seen, **options)
    # The run goes on for a while after the robot was carried away.
    while cause == "start" and not 0.1 < np.argmax(run.kidnapped) / scans < 0.85:
        options["seed"] += 1_000_000
        run = gs.worlds.simulate_run(world, seen, **options)
    ranges, odometry = run.scans, run.odometry
    if cause == "mirrored":
        ranges = ranges[:, ::-1]
    elif cause == "odometry":
        odometry = useless(odometry, rng)
    elif cause == "time":
        odometry = late(odometry, run.times, float(rng.uniform(0.4, 1.5)) * rng.choice([-1, 1]))
    return grid, scanner, run, ranges, odometry, rng


def poses_of(cause, model, run, ranges, odometry, rng, particles):
    """Return the poses that are judged."""
    if cause in ("moved", "people"):
        noise = rng.normal(0, (0.03, 0.03, 0.01), run.poses.shape)
        return run.poses + noise
    recovery = None if cause == "start" else "sensor"
    pf = gs.ParticleFilter(model, particles=particles, seed=int(rng.integers(1 << 30)), recovery=recovery)
    pf.initialize(mean=run.poses[0], covariance=np.diag(np.square(START)))
    events = [recordings.Event(0, *one) for one in zip(ranges, odometry, run.poses, strict=True)]
    return np.array([pf.estimate().pose for _ in recordings.play(pf, [model], events)])


def moved_map(grid, rng):
    """Return a map at another place: by 1 to 4 m, and up to 0.3 rad."""
    angle = float(rng.uniform(-math.pi, math.pi))
    way = float(rng.uniform(1, 4))
    move = np.array([way * math.cos(angle), way * math.sin(angle), float(rng.uniform(-0.3, 0.3))])
    center = np.array([*np.array(grid.shape[::-1]) * grid.resolution / 2, 0.0])
    about = compose_poses(compose_poses(center, move), invert_poses(center))
    return gs.OccupancyGrid(grid.cells, grid.resolution, tuple(compose_poses(about, np.array(grid.origin))))


def run(job, args):
    """Return the number of the likely cause of a run, and the milliseconds of its diagnosis; and the evidence."""
    _, cause, seed = job
    grid, scanner, made_run, ranges, odometry, rng = made(cause, seed, args.scans, args.backend)
    if cause == "moved":
        grid = moved_map(grid, rng)
    model = recordings.field(args.backend)(grid, scanner)
    poses = poses_of(cause, model, made_run, ranges, odometry, rng, args.particles)
    moments = [Moment(*one) for one in zip(ranges, poses, odometry, made_run.times, strict=True)]
    begin = time.perf_counter()
    found = diagnose_run(model, moments)
    ms = (time.perf_counter() - begin) * 1000
    return np.array([[FOUND.index("mirrored" if found.mirrored else found.cause), ms]]), (found.text,)


def page(files):
    """Return the confusion table of shards as text, and its figures."""
    found = []
    for file in files:
        with np.load(file) as data:
            for job, (number, ms) in zip(data["jobs"], data["rows"].tolist(), strict=True):
                _, cause, seed, text = ast.literal_eval(str(job))
                found.append((cause, seed, FOUND[int(number)], ms, text))
    rows, result = [], {}
    for cause in dict.fromkeys(name for name in CAUSES if name in {one[0] for one in found}):
        mine = sorted(one for one in found if one[0] == cause)
        counts = Counter(one[2] for one in mine)
        ms = float(np.median([one[3] for one in mine]))
        shares = (100 * each / len(mine) for each in (counts[cause], counts[cause] + counts["unknown"]))
        rows.append((cause, len(mine), *(counts[name] or "" for name in FOUND), *(f"{one:.0f}" for one in shares),
                     f"{ms:.0f}"))  # fmt: skip
        result[cause] = dict(counts, ms=ms)
        for _, seed, name, _, text in mine:
            if name != cause:
                note(f"{cause} {seed}: {name}: {text}")
    return table(COLUMNS, rows), dict(causes=result)


def main() -> None:
    parser = make_parser(__doc__, backend="opencl", seed=False)
    parser.add_argument("--runs", type=int, default=20, help="of each cause (default: %(default)s)")
    parser.add_argument("--scans", type=int, default=120, help="of each run (default: %(default)s)")
    parser.add_argument("--particles", type=int, default=1000)
    parser.add_argument("--causes", nargs="+", default=list(CAUSES), choices=CAUSES)
    runs.add_shards(parser, "causes_shard.npz")
    args = parse(parser)
    if args.join is None:
        jobs = [("simulated", cause, seed) for seed in range(args.runs) for cause in args.causes]
        runs.run_shard(args, jobs, lambda job: run(job, args), "bench/studies/causes.py")
        return
    publish(__file__, args, *page(args.join))


if __name__ == "__main__":
    main()
