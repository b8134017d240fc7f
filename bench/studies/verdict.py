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

import ast
import itertools
import math
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import recordings
import verdict_runs as runs
from common import make_parser, parse, publish, table

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


FIELDS = ("group", "name", "case", "other", "people", "moved", "glass", "seed")
ERROR, HEADING, P_LOST, WORD, RATIO, DEVIATION = range(6)
LATE = 20
THRESHOLDS = (0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 0.8, 0.9, 0.95)
BINS = (0.0, 0.01, 0.03, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 0.97, 1.0)


def read(files):
    """Return the runs of shards: (fields of the job, rows)."""
    found = []
    for file in files:
        with np.load(file) as data:
            ends = np.cumsum(data["lengths"])
            parts = np.split(data["rows"], ends[:-1])
            for text, rows in zip(data["jobs"], parts, strict=True):
                found.append((dict(zip(FIELDS, ast.literal_eval(str(text)), strict=True)), rows.astype(np.float64)))
    return found


def labelled(job, rows):
    """Return masks of scans with a right pose, with a wrong one as p_lost defines it, and with a long-wrong one."""
    known = np.isfinite(rows[:, ERROR])
    wrong = np.full(len(rows), job["case"] == "wrong")
    near = known & ~wrong & (rows[:, ERROR] < 1) & (rows[:, HEADING] < 0.5)
    off = (known & ~near) | wrong
    far = (known & (rows[:, ERROR] > 2)) | wrong
    since, late = 0, np.zeros(len(rows), bool)
    for k, one in enumerate(far):
        if known[k] or wrong[k]:
            since = since + 1 if one else 0
        late[k] = since > LATE and one
    return near, off, late


def figures(found):
    """Return figures of runs."""
    parts = [(rows, *labelled(job, rows)) for job, rows in found]
    rows = np.concatenate([part[0] for part in parts])
    near, late = (np.concatenate([part[k] for part in parts]) for k in (1, 3))
    p, word = rows[:, P_LOST], rows[:, WORD]
    finals = [_final(*part) for part in parts]
    judged = [one for one in finals if one is not None]
    return dict(
        runs=len(found), scans=len(rows), right=int(near.sum()), late=int(late.sum()),
        false=_share(p[near] > 0.5), false_word=_share(word[near] == 2), not_tracking=_share(word[near] != 0),
        missed=_share(p[late] <= 0.5), missed_tracking=_share(word[late] == 0), uncertain=_share(word[late] == 1),
        finals=len(judged), finals_wrong=sum(not one for one in judged), auroc=auroc(p, near, late),
    )  # fmt: skip


def _final(rows, near, off, late):
    """Return whether the last verdict is right; None where the last pose is neither right nor wrong for long."""
    if near[-1]:
        return rows[-1, P_LOST] <= 0.5
    return rows[-1, P_LOST] > 0.5 if late[-1] else None


def _share(values):
    return float(np.mean(values)) if len(values) else None


def auroc(p, near, late):
    """Return the area under the ROC curve of p: scans that are wrong for long against right ones."""
    from scipy.stats import rankdata

    values = np.concatenate([p[late], p[near]])
    one, two = int(late.sum()), int(near.sum())
    if not one or not two:
        return None
    return float((rankdata(values)[:one].sum() - one * (one + 1) / 2) / (one * two))


def roc(found):
    """Return (threshold, share of right scans above, share of late ones above)."""
    parts = [(rows, *labelled(job, rows)) for job, rows in found]
    p = np.concatenate([part[0][:, P_LOST] for part in parts])
    near, late = (np.concatenate([part[k] for part in parts]) for k in (1, 3))
    return [(t, _share(p[near] > t), _share(p[late] > t)) for t in THRESHOLDS]


def reliability(found):
    """Return (low, high, scans, mean of p_lost, share of wrong poses) for bins of p_lost."""
    parts = [(rows, *labelled(job, rows)) for job, rows in found]
    p = np.concatenate([part[0][:, P_LOST] for part in parts])
    near, off = (np.concatenate([part[k] for part in parts]) for k in (1, 2))
    known, result = near | off, []
    for k, (low, high) in enumerate(itertools.pairwise(BINS)):
        chosen = known & (p >= low) & ((p < high) | (k == len(BINS) - 2))
        result.append((low, high, int(chosen.sum()), _share(p[chosen]), _share(off[chosen])))
    return result


def at_share(bins, share=0.1):
    """Return the share of each bin that is off where `share` of all scans are, by weights of scans that are off.

    A study has more wrong poses than a robot's day. Its other scans keep their weight. Without scans of
    both kinds there is no such share: None.
    """
    off = sum(count * happened for _, _, count, _, happened in bins if count)
    right = sum(count for _, _, count, _, _ in bins) - off
    if not off or not right:
        return [None] * len(bins)
    weight = share / (1 - share) * right / off
    return [
        None if not count else weight * happened / (weight * happened + 1 - happened)
        for _, _, count, _, happened in bins
    ]


def _text(value, form=".2f", scale=100.0):
    return "-" if value is None else f"{scale * value:{form}}"


COLUMNS = (
    "runs of", "runs", "false alarms [%]", "said 'lost' [%]", "right, not tracking [%]", "missed [%]",
    "missed, tracking [%]", "last verdict right", "AUROC",
)  # fmt: skip
RATES = ("false", "false_word", "not_tracking", "missed", "missed_tracking")


def _cells(name, r):
    finals = f"{r['finals'] - r['finals_wrong']} of {r['finals']}"
    return name, r["runs"], *(_text(r[share]) for share in RATES), finals, _text(r["auroc"], ".4f", 1.0)


def reliability_table(groups):
    """Format the table of groups of bins."""
    rows = []
    for k, (low, high) in enumerate(itertools.pairwise(BINS)):
        values = [(bins[k][2], (*bins[k][3:], at_share(bins)[k])) for bins in groups.values()]
        cells = (f"{count}: {', '.join(_text(value, '.3f', 1.0) for value in each)}" for count, each in values)
        rows.append((f"{low} to {high}", *cells))
    return table(("p_lost", *groups), rows)


def commands(files):
    """Return the commands that made shards."""
    for file in files:
        with np.load(file) as data:
            yield str(data["command"])


def page(files):
    """Return the tables of shards, and their figures."""
    found = read(files)
    groups = {name: [one for one in found if one[0]["group"] == name] for name in ("tuning", "held out", "simulated")}
    groups = {name: chosen for name, chosen in groups.items() if chosen}
    rows, result = [], {}
    for name, chosen in groups.items():
        result[name] = figures(chosen)
        rows.append(_cells(f"**{name}**", result[name]))
        for field in ("case", "people", "moved", "glass", "name"):
            for value in sorted({job[field] for job, _ in chosen}, key=str):
                part = [one for one in chosen if one[0][field] == value]
                if len(part) < len(chosen):
                    label = value if isinstance(value, str) else f"{field} {100 * value:.0f} %"
                    result[f"{name}, {field} {value}"] = figures(part)
                    rows.append(_cells(f"{name}: {label}", result[f"{name}, {field} {value}"]))
    curves = {name: roc(chosen) for name, chosen in groups.items()}
    bins = {name: reliability(chosen) for name, chosen in groups.items()}
    text = "\n\n".join([
        table(COLUMNS, rows),
        "ROC: share of right scans, and of scans off for long, with p_lost above a threshold [%]",
        table(("threshold", *groups), [
            (threshold, *(f"{_text(curve[k][1])}, {_text(curve[k][2])}" for curve in curves.values()))
            for k, threshold in enumerate(THRESHOLDS)
        ]),
        "Reliability: scans of a range of p_lost, its mean, the share that is off by 1 m or 0.5 rad, and that share "
        "where a tenth of all scans is off",
        reliability_table(bins),
        "Shards: " + "; ".join(f"`{command}`" for command in commands(files)) + ".",
    ])  # fmt: skip
    return text, dict(commands=list(commands(files)), figures=result, roc=curves, reliability=bins)


if __name__ == "__main__":
    main()
