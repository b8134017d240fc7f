"""Count reference poses that their own scans contradict, and what they do to the coverage of the filter's regions.

Errors and coverage are those against reference poses, which are not free of errors. A reference is contradicted where
the scan is likelier at the filter's estimate by NATS at least, with all beams and in every run. The reverse, estimates
that are contradicted by as much, is the control.

    python bench/studies/references.py --seeds 3 --out references_cpu.json
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import recordings

from gpusense.evaluation.coverage import coverage_report
from gpusense.evaluation.machine import machine, machine_line

NATS = 100.0
LOGS = (*recordings.CARMEN, "intel-raw", "olin", "jarvis-s3000", "jarvis-nav350")


def gains(recording, model, track):
    """Return how much likelier each scan is at the estimate than at the reference [nats]; NaN without a reference."""
    found = np.full(len(recording.events), np.nan)
    for k, event in enumerate(recording.events):
        if np.isfinite(event.truth).all():
            poses = np.array([event.truth, event.truth + track.differences[k]])
            there, here = model.log_likelihood(poses, event.ranges)
            found[k] = here - there
    return found


def study(name, backend, particles, seeds):
    """Return the figures of a log: references, those contradicted, their distances, and coverage with and without."""
    recording = recordings.load(name)
    models = recording.models(recordings.field(backend))
    tracks = [recordings.follow(recording, models, particles=particles, seed=seed) for seed in range(seeds)]
    gained = np.array([gains(recording, models[0], track) for track in tracks])
    known = np.isfinite(gained[0])
    known[: len(known) // 20] = False
    wrong = known & (gained > NATS).all(axis=0)
    differences = np.median([track.differences[wrong] for track in tracks], axis=0)
    coverage = {}
    for title, chosen in (("all", known), ("others", known & ~wrong)):
        reports = [coverage_report(t.differences[chosen], t.covariances[chosen], t.ranks[chosen]) for t in tracks]
        coverage[title] = [float(np.mean([r[f"coverage_{k}"] for r in reports])) for k in (50, 80, 95)]
    return dict(
        log=name, particles=particles, seeds=seeds, references=int(known.sum()), contradicted=int(wrong.sum()),
        estimates_contradicted=int((known & (gained < -NATS).all(axis=0)).sum()),
        farthest_cm=100 * float(np.hypot(*differences[:, :2].T).max(initial=0)),
        farthest_deg=float(np.degrees(np.abs(differences[:, 2]).max(initial=0))), coverage=coverage,
    )  # fmt: skip


def _line(r):
    both = " | ".join(", ".join(f"{value:.2f}" for value in r["coverage"][which]) for which in ("all", "others"))
    farthest = f"{r['farthest_cm']:.0f} cm, {r['farthest_deg']:.1f} deg"
    counts = f"{r['references']} | {r['contradicted']} | {farthest} | {r['estimates_contradicted']}"
    return f"| {r['log']} | {counts} | {both} |"


_HEAD = (
    "| log | references | contradicted | farthest | estimates contradicted | "
    "coverage 50, 80, 95 %, all | without them |",
    "| --- | --- | --- | --- | --- | --- | --- |",
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backend", default="opencl")
    parser.add_argument("--logs", nargs="+", default=list(LOGS), choices=LOGS)
    parser.add_argument("--particles", type=int, default=2000)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--out", type=Path, help="a .json file; the table goes to the .md file beside it")
    args = parser.parse_args()
    print("\n".join(_HEAD))
    rows = []
    for name in args.logs:
        rows.append(study(name, args.backend, args.particles, args.seeds))
        print(_line(rows[-1]), flush=True)
    if args.out is not None:
        command = " ".join(["bench/studies/references.py", *sys.argv[1:]])
        args.out.write_text(json.dumps(dict(machine=machine(), command=command, results=rows), indent=1))
        table = "\n".join([*_HEAD, *map(_line, rows)])
        args.out.with_suffix(".md").write_text(f"{machine_line()}\n\n`python {command}`\n\n{table}\n")


if __name__ == "__main__":
    main()
