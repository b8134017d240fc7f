"""Shares of beams that poses explain, on the right map and on a wrong one: where a filter counts as lost.

On the right map the pose is the likeliest of 500 near the reference, on a wrong one the likeliest of 4 000 anywhere and
2 000 around that one. The filter averages shares over five scans or so.

    python bench/studies/verdict.py --out bench/results/verdict_cpu.json
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "accuracy"))

import numpy as np
import recordings
from localization_logs import makers

from gpusense.evaluation.machine import machine, machine_line
from gpusense.localization import starts
from gpusense.localization.verdict import explained_share

# Map of another log for each.
WRONG = {
    "intel": "csail", "csail": "aces", "fr079": "intel", "aces": "fr079", "jarvis-s3000": "intel", "olin": "csail",
}  # fmt: skip
ANYWHERE, AROUND, NEAR = 4000, 2000, 500
LEVELS = (5, 25, 50, 75, 95)


def likeliest(model, ranges, centre, deviations, count, rng):
    """Return the likeliest of normal poses around a pose."""
    poses = centre + rng.normal(0, deviations, (count, 3))
    return poses[np.argmax(model.log_likelihood(poses, ranges))]


def shares(model, events, *, right, rng):
    """Return the explained share of each scan."""
    pool, spread = starts.free_pool([model], None)
    anywhere, result = starts.spread(pool, spread, ANYWHERE, (1, 2, 3)), []
    for event in events:
        terms = np.asarray(model.log_likelihood(anywhere, event.ranges, per_beam=True)[1], np.float64)
        if right:
            pose = likeliest(model, event.ranges, event.truth, (0.05, 0.05, 0.01), NEAR, rng)
        else:
            best = anywhere[np.argmax(terms.sum(axis=1))]
            pose = likeliest(model, event.ranges, best, (0.1, 0.1, 0.05), AROUND, rng)
        at = np.asarray(model.log_likelihood(pose[None], event.ranges, per_beam=True)[1], np.float64)[0]
        result.append(explained_share(at, terms[:64]))
    return np.array(result)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backend", default="opencl")
    parser.add_argument("--logs", nargs="+", default=list(WRONG), choices=list(WRONG))
    parser.add_argument("--models", nargs="+", default=["field", "beam", "discrete"])
    parser.add_argument("--beams", type=int, default=60)
    parser.add_argument("--scans", type=int, default=40, help="scans of each log, evenly")
    parser.add_argument("--out", type=Path, help="a .json file; the table goes to the .md file beside it")
    args = parser.parse_args()
    rng, results = np.random.default_rng(0), []
    lines = [f"| log | model | map | {', '.join(map(str, LEVELS))} % of the shares |", "| --- | --- | --- | --- |"]
    for name in args.logs:
        recording, other = recordings.load(name), recordings.load(WRONG[name])
        chosen = np.linspace(20, len(recording.events) - 1, args.scans).astype(int)
        events = [recording.events[k] for k in chosen]
        scanner = recording.places[0][1]
        for kind in args.models:
            for which, grid in (("right", recording.places[0][0]), ("wrong", other.places[0][0])):
                model = makers(kind, args.backend, args.beams)(grid, scanner)
                levels = np.percentile(shares(model, events, right=which == "right", rng=rng), LEVELS).round(2)
                results.append(dict(log=name, model=kind, map=which, levels=levels.tolist()))
                lines.append(f"| {name} | {kind} | {which} | {', '.join(f'{v:.2f}' for v in levels)} |")
                print(lines[-1], flush=True)
    if args.out is not None:
        command = " ".join(["bench/studies/verdict.py", *sys.argv[1:]])
        args.out.write_text(json.dumps(dict(machine=machine(), command=command, results=results), indent=1))
        table = "\n".join(lines)
        args.out.with_suffix(".md").write_text(f"{machine_line()}\n\n`python {command}`\n\n{table}\n")


if __name__ == "__main__":
    main()
