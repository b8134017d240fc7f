"""Runs of a filter for the study of the verdict: recorded and simulated, with people, moved walls, glass, wrong maps.

The logs of the data folder are split in two by name before any result: alternate names are for tuning and held out.
"""

from __future__ import annotations

import functools
import math
import time
from pathlib import Path

import numpy as np
import recordings
from common import command_line, part_of

import gpusense as gs
from gpusense._util.progress import progress
from gpusense.evaluation.log_steps import read_steps
from gpusense.world.pose_algebra import compose_poses

# Names of the logs in the data folder; intel-rawodom is a part of intel, and the lasers of jarvis are one log.
LOGS = (
    "acapulco", "aces", "belgioioso", "csail", "fhw", "freiburg-079", "infinite-corridor", "intel", "jarvis", "olin",
    "seattle",
)  # fmt: skip
TUNING, HELD_OUT = LOGS[::2], LOGS[1::2]
# Recordings of each log.
PARTS = {"freiburg-079": ("fr079",), "intel": ("intel", "intel-raw"), "jarvis": ("jarvis-s3000", "jarvis-nav350")}


@functools.cache
def load(part):
    """Return a recording: one of ``recordings``, or odd scans of a CARMEN log in a map of the even ones."""
    if part in recordings.NAMES:
        return recordings.load(part)
    folder = recordings.data() / "carmen_logs"
    steps = read_steps(folder / f"{part}-corrected.log.gz", every=2, offset=1)
    file = folder / "derived_maps" / f"{part}_{'all' if part.startswith('infinite') else 'even'}_05cm.yaml"
    grid = gs.read_map(file) if file.exists() else _built(folder / f"{part}-corrected.log.gz")
    events = [recordings.Event(0, s.scan.ranges, np.array(s.odometry), np.array(s.scan.pose)) for s in steps]
    return recordings.Recording(part, [(grid, steps[0].scan.scanner)], events)


def _built(path):
    """Return a map of the even scans at their logged poses."""
    scans = [step.scan for step in read_steps(path, every=2)]
    ranges, poses = np.array([scan.ranges for scan in scans]), np.array([scan.pose for scan in scans])
    ranges = np.where(ranges < 20, ranges, np.nan)
    return gs.build_map(ranges, poses, scans[0].scanner, resolution=0.05)


def parts_of(log):
    return PARTS.get(log, (log,))


def crowded(events, bearings, share, rng):
    """Return events in which people hide a share of the beams on average.

    A person covers 10 to 25 degrees at 0.4 to 2.5 m, walks around the robot by a few degrees a scan, and stays for 10
    to 40 scans. Their number is the share times the field of view by the mean width.
    """
    if not share:
        return events
    span = float(bearings.max() - bearings.min())
    many = share * span / math.radians(17.5)
    people, result = [], []
    for event in events:
        wanted = rng.poisson(many) if not people else len(people)
        people = [p for p in people if p[4] > 0]
        while len(people) < max(wanted, round(many)) and len(people) < 60:
            people.append([rng.uniform(bearings.min(), bearings.max()), math.radians(rng.uniform(10, 25)),
                           rng.uniform(0.4, 2.5), rng.normal(0, math.radians(3)), rng.integers(10, 40)])  # fmt: skip
        ranges = np.array(event.ranges, np.float64)
        for one in people:
            hidden = np.abs(gs.wrap_angle(bearings - one[0])) < one[1] / 2
            ranges = np.where(
                hidden & ((ranges > one[2]) | np.isinf(ranges)), one[2] + rng.normal(0, 0.03, len(ranges)), ranges
            )
            one[0] += one[3]
            one[4] -= 1
        result.append(recordings.Event(event.scanner, ranges, event.odometry, event.truth))
    return result


def rearranged(grid, share, rng, *, shift=(0.3, 1.0), gone=0.0):
    """Return a map with a share of its 1.5 m blocks moved by ``shift`` [m], and a share ``gone`` of these removed."""
    if not share:
        return grid
    side = max(round(1.5 / grid.resolution), 1)
    cells = np.array(grid.cells)
    occupied = np.asarray(grid.occupied)
    old = occupied.copy()
    rows, columns = cells.shape
    blocks = [(r, c) for r in range(0, rows, side) for c in range(0, columns, side)
              if occupied[r : r + side, c : c + side].any()]  # fmt: skip
    rng.shuffle(blocks)
    moves = []
    for r, c in blocks[: round(share * len(blocks))]:
        own = np.argwhere(old[r : r + side, c : c + side]) + np.array([r, c])
        cells[own[:, 0], own[:, 1]] = 0
        angle, distance = rng.uniform(-math.pi, math.pi), rng.uniform(*shift) / grid.resolution
        if rng.random() >= gone:
            moves.append(own + np.round([distance * math.sin(angle), distance * math.cos(angle)]).astype(int))
    for place in moves:
        kept = place[((place >= 0) & (place < (rows, columns))).all(axis=1)]
        cells[kept[:, 0], kept[:, 1]] = 100
    return gs.OccupancyGrid(cells, grid.resolution, grid.origin, occupied_threshold=grid.occupied_threshold)


def window(events, length, rng, *, kidnapped=False):
    """Return a part of a run; kidnapped, it goes on after a half elsewhere, as if the robot had stood still."""
    length = min(length, len(events))
    first = int(rng.integers(len(events) - length + 1))
    while not np.isfinite(events[first].truth).all():
        first = int(rng.integers(len(events) - length + 1))
    chosen = events[first : first + length]
    if not kidnapped:
        return chosen
    half, rest = length // 2, length - length // 2
    for _ in range(200):
        second = int(rng.integers(len(events) - rest + 1))
        known = np.isfinite(events[second].truth).all()
        if known and math.dist(chosen[half - 1].truth[:2], events[second].truth[:2]) > 5:
            break
    else:
        return None
    after = events[second : second + rest]
    start = chosen[half - 1].odometry
    moved = [
        recordings.Event(
            e.scanner, e.ranges, compose_poses(start, gs.pose_difference(after[0].odometry, e.odometry)), e.truth
        )
        for e in after
    ]
    return [*chosen[:half], *moved]


def simulated(seed, *, scans=60, hidden=0.0, moved=0.0, glass=0.0, beams=180, around=False, step=0.2, case="own"):
    """Return a map, a scanner and events of a simulated robot.

    ``hidden``, ``moved`` and ``glass`` are shares of beams and walls; a third as much furniture as ``moved`` is new.
    ``case``: "own", the map shows the world; "kidnapped", the robot is carried away once; "wrong", the map shows
    another building.
    """
    rng = np.random.default_rng(seed)

    def building(number):
        return gs.worlds.building(seed=number, size=(float(rng.uniform(18, 40)), float(rng.uniform(14, 30))))

    grid = building(seed)
    changes = dict(world=building(seed + 500_000)) if case == "wrong" else dict(moved=moved, added=moved / 3)
    span = math.tau if around else math.pi
    scanner = gs.Scanner.uniform(
        angle_min=-span / 2, angle_increment=span / max(beams - (not around), 1), count=beams, range_max=20.0
    )
    run = gs.worlds.simulate_run(
        grid, scanner, scans=scans, hidden=hidden, glass=glass, kidnaps=int(case == "kidnapped"), step=step, seed=seed,
        backend="opencl", **changes,
    )  # fmt: skip
    return grid, scanner, recordings.simulated_events(run)


def add_shards(parser, raw):
    """Add the options of a study that runs in shards, whose runs lie in the file ``raw``."""
    parser.add_argument("--shard", type=part_of, default=(1, 1), metavar="I/N")
    parser.add_argument("--seconds", type=float, help="begin no more runs of the shard after this time")
    parser.add_argument("--raw", type=Path, default=Path(raw), help="file of the shard's runs")
    parser.add_argument("--join", type=Path, nargs="+", help="files of shards to report on")


def run_shard(args, jobs, run, script):
    """Run the jobs of a shard, and write the rows and values that ``run`` returns for each; None skips a job."""
    first, count = args.shard
    chosen = jobs[first - 1 :: count]
    kept, rows, begin = [], [], time.time()
    with progress(len(chosen)) as step:
        for job in chosen:
            if args.seconds is not None and time.time() - begin > args.seconds:
                break
            step(f"{job[1]} {job[2]}")
            made = run(job)
            if made is None:
                continue
            found, more = made
            rows.append(found)
            kept.append(repr((*job, *more)))
    lengths = np.array([len(one) for one in rows])
    np.savez_compressed(args.raw, jobs=np.array(kept), lengths=lengths, rows=np.concatenate(rows).astype(np.float32),
                        command=command_line(script))  # fmt: skip
    print(f"{len(kept)} runs, {lengths.sum()} scans in {time.time() - begin:.0f} s: {args.raw}")
