"""Protection levels of a filter against the truth: excesses, availability, time to alert.

Factor and margin of the radius are chosen on the logs ``verdict_runs.TUNING``, and the table shows the logs of
``HELD_OUT`` and simulated buildings, on which they were not chosen. Whole logs are tracked; other runs are carried away
once. Scans of a run are dependent, so a limit of a share comes from a bootstrap that draws blocks of scans, or from the
interval of Clopper and Pearson for the number of blocks if that is larger. A shard writes its runs to a file;
``--join`` makes the page of all.

    python bench/studies/protection.py --shard 1/2 --seeds 2 --raw shard_1.npz
    python bench/studies/protection.py --join shard_*.npz --output protection
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import protection_report as report
import recordings
import verdict_runs as runs
from common import make_parser, parse, publish

import gpusense as gs

WORDS = ("tracking", "uncertain", "lost")


def follow(places, events, *, backend, particles, beams, seed):
    """Return a row for each scan, as ``protection_report.ROW`` names it."""
    make = recordings.makers("field", backend, beams)
    models = [make(grid, scanner) for grid, scanner in places]
    pf = gs.ParticleFilter(models, particles=particles, seed=seed)
    recordings.start_at(pf, events[0].truth)
    rows = []
    for event in recordings.play(pf, models, events):
        e = pf.estimate()
        radii = [(e.protection_level(risk) - e.margin) / e.widening for risk in report.RISKS]
        rows.append((*recordings.errors(e.pose, event.truth), e.p_lost, WORDS.index(e.verdict), *radii))
    return np.array(rows)


def jobs(args):
    """Return all runs: (group, name, case, seed)."""
    found = []
    for seed in range(args.seeds):
        for group, logs in (("tuning", runs.TUNING), ("held out", runs.HELD_OUT)):
            parts = [part for log in logs for part in runs.parts_of(log)]
            found += [(group, part, "own", seed) for part in parts]
            found += [
                (group, part, "kidnapped", args.kidnaps * seed + k) for part in parts for k in range(args.kidnaps)
            ]
    found += [("simulated", "building", ("own", "kidnapped")[k % 2], k) for k in range(args.simulated)]
    order = np.random.default_rng(1).permutation(len(found))
    return [found[k] for k in order if found[k][0] in args.groups]


def prepared(job, args):
    """Return places, events and the index of the jump of a run; None where a log has no such part."""
    group, name, case, seed = job
    rng = np.random.default_rng((13, seed, ("own", "kidnapped").index(case)))
    if group == "simulated":
        grid, scanner, events = runs.simulated(
            40_000 + seed, scans=args.scans, hidden=float(rng.choice([0, 0.1])), beams=int(rng.choice([36, 180, 360])),
            around=bool(rng.integers(2)), step=float(rng.choice([0.1, 0.2, 0.3])), case=case,
        )  # fmt: skip
        return [(grid, scanner)], events, report.jump_of(events)
    recording = runs.load(name)
    if case == "own":
        return recording.places, recording.events[: args.most], None
    events, jump = runs.window(recording.events, args.scans, rng, kidnapped=True)
    return None if events is None else (recording.places, events, jump)


def run(job, args):
    """Return the rows of a job and the index of its jump, or -1; None where a log has no such part."""
    made = prepared(job, args)
    if made is None:
        return None
    places, events, jump = made
    options = dict(backend=args.backend, particles=args.particles, beams=args.beams, seed=job[-1])
    return follow(places, events, **options), (-1 if jump is None else jump,)


def main() -> None:
    parser = make_parser(__doc__, backend="opencl", seed=False)
    parser.add_argument("--particles", type=int, default=2000)
    parser.add_argument("--beams", type=int, help="beams of a scan that the filter uses (default: all)")
    parser.add_argument("--seeds", type=int, default=1, help="runs of each log")
    parser.add_argument("--kidnaps", type=int, default=4, help="parts of each log with a jump, for each seed")
    parser.add_argument("--simulated", type=int, default=60, help="simulated runs")
    parser.add_argument("--scans", type=int, default=120, help="scans of a simulated run, or one with a jump")
    parser.add_argument("--most", type=int, help="most scans of a log")
    parser.add_argument("--groups", nargs="+", default=list(report.GROUPS), choices=report.GROUPS)
    runs.add_shards(parser, "protection_shard.npz")
    args = parse(parser)
    if args.join is None:
        runs.run_shard(args, jobs(args), lambda job: run(job, args), "bench/studies/protection.py")
        return
    text, figures = report.page(args.join)
    publish(__file__, args, text, figures)


if __name__ == "__main__":
    main()
