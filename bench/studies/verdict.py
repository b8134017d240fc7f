"""The verdict of a filter against the truth: people, moved walls, glass, wrong maps and jumps.

The logs of the data folder are split by name before any run: alternate ones are "tuning" and "held out"
(``verdict_runs.TUNING``, ``HELD_OUT``). Constants of the verdict were chosen on simulated runs
(``bench/results/verdict.md``) and inspected on the tuning half; the table has both halves side by side.

A false alarm is a scan with p_lost above 0.5 whose pose is within 1 m and 0.5 rad of the reference, because of a wide
cloud or contradicting scans; the next column counts only those with the verdict "lost". A miss is a scan with p_lost of
at most 0.5 whose pose has been wrong by more than 2 m, or on a wrong map, for more than 20 scans. A shard writes its
runs to a file; ``--join`` makes the page of all shards.

    python bench/studies/verdict.py --shard 1/16 --seeds 4 --maps 10 --simulated 2000 --raw shard_1.npz
    python bench/studies/verdict.py --join shard_*.npz --output verdict_cpu
"""

from __future__ import annotations

import itertools
import math
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import recordings
import verdict_runs as runs
from common import make_parser, parse, publish
from verdict_report import page

import gpusense as gs

SHARES = (0.0, 0.1, 0.3)
CASES = ("own", "kidnapped", "wrong")
GROUPS = ("tuning", "held out", "simulated")
WORDS = ("tracking", "uncertain", "lost")
SCANS, EVERYWHERE = 70, 5000


def follow(places, events, start, *, backend, particles, kind, beams, seed):
    """Return a row for each scan (errors, p_lost, verdict, ratio, deviation, pose); a start of None begins anywhere."""
    make = recordings.makers(kind, backend, beams)
    models = [make(grid, scanner) for grid, scanner in places]
    pf = gs.ParticleFilter(models, particles=particles, seed=seed)
    recordings.start_at(pf, start)
    rows = []
    for event in recordings.play(pf, models, events):
        e = pf.estimate()
        belief, word = pf._parts.verdict.state.belief, WORDS.index(e.verdict)
        rows.append((*recordings.errors(e.pose, event.truth), e.p_lost, word, belief.ratio,
                     math.sqrt(e.covariance[0, 0] + e.covariance[1, 1]), *e.pose))  # fmt: skip
    return np.array(rows)


def jobs(args):
    """Return all runs: (group, name, case, other map or None, people, moved, glass, seed)."""
    found = []
    for group, logs in (("tuning", runs.TUNING), ("held out", runs.HELD_OUT)):
        every = [log for log in runs.LOGS if log in logs]
        for log, people, moved, seed in itertools.product(every, SHARES, SHARES, range(args.seeds)):
            others = [other for other in runs.LOGS if other != log]
            rng = np.random.default_rng((runs.LOGS.index(log), round(100 * people), round(100 * moved), seed))
            chosen = rng.permutation(others)[: args.maps].tolist()
            for case, other in [("own", None), ("kidnapped", None), *(("wrong", one) for one in chosen)]:
                found.append((group, log, case, other, people, moved, 0.0, seed))
    for k in range(args.simulated):
        rng = np.random.default_rng((99, k))
        case = CASES[int(rng.choice(3, p=(0.5, 0.25, 0.25)))]
        people, moved = rng.choice(SHARES, 2)
        found.append(("simulated", "building", case, None, float(people), float(moved), float(k % 4 == 3) * 0.1, k))
    # In a fixed random order, so that shards take equally long.
    order = np.random.default_rng(1).permutation(len(found))
    return [found[k] for k in order if found[k][0] in args.groups]


def prepared(job, args):
    """Return places, events and start of a run; None where a log has no such part."""
    group, name, case, other, people, moved, glass, seed = job
    rng = np.random.default_rng((7, seed, CASES.index(case), round(100 * people), round(100 * moved)))
    if group == "simulated":
        grid, scanner, events = runs.simulated(
            1000 + seed, scans=60, hidden=people, moved=moved, glass=glass, beams=int(rng.choice([16, 36, 180, 360])),
            around=bool(rng.integers(2)), step=float(rng.choice([0.1, 0.2, 0.3])), case=case,
        )  # fmt: skip
        return [(grid, scanner)], events, _start(case, grid, events, rng)
    parts = runs.parts_of(name)
    recording = runs.load(parts[seed % len(parts)])
    events = runs.window(recording.events, SCANS, rng, kidnapped=case == "kidnapped")
    if events is None:
        return None
    places = recording.places
    if other is not None:
        places = [(runs.load(runs.parts_of(other)[0]).places[0][0], scanner) for _, scanner in places]
    places = [(runs.rearranged(grid, moved, rng), scanner) for grid, scanner in places]
    events = runs.crowded(events, places[0][1].bearings, people, rng)
    return places, events, _start(case, places[0][0], events, rng)


def _start(case, grid, events, rng):
    """Return the pose at which a run begins: the reference; on a wrong map a free pose, or None for anywhere."""
    if case != "wrong":
        return events[0].truth
    return None if rng.integers(2) else gs.worlds.free_pose(grid, rng, 0.2)


def run(job, args):
    """Return the rows of a job; None where a log has no such part."""
    made = prepared(job, args)
    if made is None:
        return None
    places, events, start = made
    particles = EVERYWHERE if start is None else args.particles
    return follow(places, events, start, backend=args.backend, particles=particles, kind=args.model, beams=args.beams,
                  seed=job[-1]), ()  # fmt: skip


def main() -> None:
    parser = make_parser(__doc__, backend="opencl", seed=False)
    parser.add_argument("--model", default="field", choices=("field", "beam", "discrete"))
    parser.add_argument("--particles", type=int, default=500)
    parser.add_argument("--beams", type=int, default=60)
    parser.add_argument("--seeds", type=int, default=1, help="windows of each log and setting")
    parser.add_argument("--maps", type=int, default=2, help="other maps of each log and setting")
    parser.add_argument("--simulated", type=int, default=300, help="simulated runs")
    parser.add_argument("--groups", nargs="+", default=list(GROUPS), choices=GROUPS)
    parser.add_argument("--limit", type=int, help="most runs of the shard")
    runs.add_shards(parser, "verdict_shard.npz")
    args = parse(parser)
    if args.join is None:
        first, count = args.shard
        chosen = jobs(args) if args.limit is None else jobs(args)[: first - 1 + count * args.limit]
        runs.run_shard(args, chosen, lambda job: run(job, args), "bench/studies/verdict.py")
        return
    text, report = page(args.join)
    publish(__file__, args, text, report)


if __name__ == "__main__":
    main()
