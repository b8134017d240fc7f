"""Carry a tracked robot elsewhere without its odometry, and count the scans until the filter has found it again.

Each run tracks intel from the logged pose for some scans, and continues at another part of the log as if the robot had
stood still. The robot is found where five scans in a row are within 1 m and 20 degrees.

    python bench/studies/kidnapping.py --runs 10 --output kidnapping_cpu
"""

from __future__ import annotations

import functools
import itertools
import math
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import recordings
from common import make_parser, note, parse, publish, table

import gpusense as gs
from gpusense.evaluation.tracking import CONVERGED, CONVERGED_SCANS, CONVERGED_TURN

# Scans before and after the jump.
BEFORE, AFTER = 20, 80
COLUMNS = ("recovery", "particles", "found again", "median scans", "scans off that say lost [%]")


@functools.cache
def _recording(backend, beams):
    """Return the recording and its models."""
    recording = recordings.load("intel")
    return recording, recording.models(recordings.field(backend, beams=beams))


def run(seed, recovery, particles, backend, beams):
    """Return how many scans after the jump the robot is found, None if never, and how many wrong scans say lost."""
    recording, models = _recording(backend, beams)
    events, rng = recording.events, np.random.default_rng(seed)
    first, second = int(rng.integers(len(events) - BEFORE)), int(rng.integers(len(events) - AFTER))
    while math.dist(events[first + BEFORE].truth[:2], events[second].truth[:2]) < 5:
        second = int(rng.integers(len(events) - AFTER))
    pf = gs.ParticleFilter(models, particles=particles, seed=seed, recovery=recovery)
    recordings.start_at(pf, events[first].truth)
    for _ in recordings.play(pf, models, events[first : first + BEFORE]):
        pf.estimate()
    near, said = 0, 0
    for k, event in enumerate(recordings.play(pf, models, events[second : second + AFTER])):
        found = pf.estimate()
        distance, turn = recordings.errors(found.pose, event.truth)
        close = distance < CONVERGED and turn < CONVERGED_TURN
        near = near + 1 if close else 0
        said += bool(not close and found.lost)
        if near == CONVERGED_SCANS:
            return k + 1 - CONVERGED_SCANS, said
    return None, said


def main() -> None:
    parser = make_parser(__doc__, backend="opencl", seed=False)
    parser.add_argument("--particles", nargs="+", type=int, default=[2000])
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--beams", type=int, default=60)
    parser.add_argument("--processes", type=int, default=1, help="runs at once, each with one thread")
    args = parse(parser)
    lines, rows = [], []
    settings = list(itertools.product(args.particles, (None, "augmented", "sensor")))
    jobs = [
        (seed, recovery, particles, args.backend, args.beams)
        for particles, recovery in settings
        for seed in range(args.runs)
    ]
    done = recordings.results(run, jobs, args.processes)
    for particles, recovery in settings:
        runs = list(itertools.islice(done, args.runs))
        scans = [one for one, _ in runs if one is not None]
        off = sum(AFTER if one is None else one for one, _ in runs)
        row = dict(recovery=recovery, particles=particles, runs=len(runs), found=len(scans),
                   median_scans=float(np.median(scans)) if scans else None, scans=[one for one, _ in runs],
                   said_lost=sum(said for _, said in runs) / max(off, 1))  # fmt: skip
        rows.append(row)
        median = "-" if not scans else f"{row['median_scans']:.0f}"
        lines.append((recovery, particles, f"{len(scans)} of {len(runs)}", median, f"{100 * row['said_lost']:.0f}"))
        note(str(lines[-1]))
    publish(__file__, args, table(COLUMNS, lines), dict(results=rows))


if __name__ == "__main__":
    main()
