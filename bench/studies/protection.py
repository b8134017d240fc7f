"""Protection levels of a filter against the truth: excesses, availability, time to alert.

The factor that widens the spread is chosen on the logs ``verdict_runs.TUNING``, and the table shows the logs of
``HELD_OUT`` and simulated buildings, on which it was not chosen. Whole logs are tracked; other runs are carried away
once. Scans of a run are dependent, so a limit of a share comes from a bootstrap that draws blocks of scans, or from the
interval of Clopper and Pearson for the number of blocks if that is larger. A shard writes its runs to a file;
``--join`` makes the page of all.

    python bench/studies/protection.py --shard 1/2 --seeds 2 --raw shard_1.npz
    python bench/studies/protection.py --join shard_*.npz --output protection
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import protection_report as report
import recordings
import verdict_runs as runs
from common import command_line, make_parser, parse, part_of, publish

import gpusense as gs
from gpusense._util.progress import progress

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
        radii = [e.protection_level(risk) / e.widening for risk in report.RISKS]
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


def run_shard(args):
    """Run the jobs of a shard and write their rows."""
    first, count = args.shard
    chosen = jobs(args)[first - 1 :: count]
    kept, rows, begin = [], [], time.time()
    with progress(len(chosen)) as step:
        for job in chosen:
            if args.seconds is not None and time.time() - begin > args.seconds:
                break
            step(f"{job[1]} {job[2]}")
            made = prepared(job, args)
            if made is None:
                continue
            places, events, jump = made
            options = dict(backend=args.backend, particles=args.particles, beams=args.beams, seed=job[-1])
            rows.append(follow(places, events, **options))
            kept.append(repr((*job, -1 if jump is None else jump)))
    lengths = np.array([len(one) for one in rows])
    np.savez_compressed(args.raw, jobs=np.array(kept), lengths=lengths, rows=np.concatenate(rows).astype(np.float32),
                        command=command_line("bench/studies/protection.py"))  # fmt: skip
    print(f"{len(kept)} runs, {lengths.sum()} scans in {time.time() - begin:.0f} s: {args.raw}")


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
    parser.add_argument("--shard", type=part_of, default=(1, 1), metavar="I/N")
    parser.add_argument("--seconds", type=float, help="begin no more runs of the shard after this time")
    parser.add_argument("--raw", type=Path, default=Path("protection_shard.npz"), help="file of the shard's runs")
    parser.add_argument("--join", type=Path, nargs="+", help="files of shards to report on")
    args = parse(parser)
    if args.join is None:
        run_shard(args)
        return
    text, figures = report.page(args.join)
    publish(__file__, args, text, figures)


if __name__ == "__main__":
    main()
