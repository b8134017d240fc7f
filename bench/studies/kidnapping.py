"""Carry a tracked robot elsewhere without its odometry, and count the scans until the filter has found it again.

Each run tracks intel for some scans from the logged pose, and goes on at another part of the log as if the robot had
stood still. It is found where five scans in a row are within 1 m and 20 degrees.

    python bench/studies/kidnapping.py --runs 10 --out kidnapping_cpu.json
"""

from __future__ import annotations

import argparse
import functools
import itertools
import json
import math
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import recordings
from parallel import results

import gpusense as gs
from gpusense.evaluation.machine import machine, machine_line
from gpusense.evaluation.tracking import CONVERGED, CONVERGED_SCANS, CONVERGED_TURN, START

# Scans before and after the jump.
BEFORE, AFTER = 20, 80


@functools.cache
def _model(backend, beams):
    """Return the recording and its model."""
    recording = recordings.load("intel")
    return recording, *recording.models(recordings.field(backend, beams=beams))


def run(seed, recovery, particles, backend, beams):
    """Return the number of scans after the jump until the robot is found, None if never, and those said lost before."""
    recording, model = _model(backend, beams)
    rng = np.random.default_rng(seed)
    count = len(recording.events)
    first, second = int(rng.integers(count - BEFORE)), int(rng.integers(count - AFTER))
    while math.dist(recording.events[first + BEFORE].truth[:2], recording.events[second].truth[:2]) < 5:
        second = int(rng.integers(count - AFTER))
    pf = gs.ParticleFilter(model, particles=particles, seed=seed, recovery=recovery)
    pf.initialize(mean=recording.events[first].truth, covariance=np.diag(np.square(START)))
    near, said = 0, 0
    for part, begin, length in ((0, first, BEFORE), (1, second, AFTER)):
        events = recording.events[begin : begin + length]
        for k, event in enumerate(events):
            if k:
                pf.predict(events[k - 1].odometry, event.odometry)
            pf.correct(event.ranges)
            found = pf.estimate()
            off = found.pose - event.truth
            close = math.hypot(*off[:2]) < CONVERGED and abs(math.remainder(off[2], math.tau)) < CONVERGED_TURN
            near = near + 1 if part and close else 0
            said += bool(part and not close and found.lost)
            if near == CONVERGED_SCANS:
                return k + 1 - CONVERGED_SCANS, said
    return None, said


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backend", default="opencl")
    parser.add_argument("--particles", nargs="+", type=int, default=[2000])
    parser.add_argument("--runs", type=int, default=10)
    parser.add_argument("--beams", type=int, default=60)
    parser.add_argument("--processes", type=int, default=1, help="runs at once, each with one thread")
    parser.add_argument("--out", type=Path, help="a .json file; the table goes to the .md file beside it")
    args = parser.parse_args()
    head = (
        "| recovery | particles | found again | median scans | scans off that say lost [%] |",
        "| --- | --- | --- | --- | --- |",
    )
    lines, rows = list(head), []
    settings = list(itertools.product(args.particles, (None, "augmented", "sensor")))
    jobs = [
        (seed, recovery, particles, args.backend, args.beams)
        for particles, recovery in settings
        for seed in range(args.runs)
    ]
    done = results(run, jobs, args.processes)
    for particles, recovery in settings:
        runs = list(itertools.islice(done, args.runs))
        scans = [one for one, _ in runs if one is not None]
        off = sum(AFTER if one is None else one for one, _ in runs)
        row = dict(recovery=recovery, particles=particles, runs=len(runs), found=len(scans),
                   median_scans=float(np.median(scans)) if scans else None, scans=[one for one, _ in runs],
                   said_lost=sum(said for _, said in runs) / max(off, 1))  # fmt: skip
        rows.append(row)
        median = "-" if not scans else f"{row['median_scans']:.0f}"
        lines.append(
            f"| {recovery} | {particles} | {len(scans)} of {len(runs)} | {median} | {100 * row['said_lost']:.0f} |"
        )
        print(lines[-1], flush=True)
    if args.out is not None:
        command = " ".join(["bench/studies/kidnapping.py", *sys.argv[1:]])
        args.out.write_text(json.dumps(dict(machine=machine(), command=command, results=rows), indent=1))
        args.out.with_suffix(".md").write_text("\n".join([f"{machine_line()}\n\n`python {command}`\n", *lines]) + "\n")


if __name__ == "__main__":
    main()
