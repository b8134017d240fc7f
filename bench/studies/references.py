"""Count reference poses that their own scans contradict, and their effect on the coverage of the filter's regions.

Errors and coverage are measured against reference poses, which have errors themselves. A reference is contradicted
where the scan with all beams is likelier at the filter's estimate by at least NATS in every run. The control is the
reverse: estimates that are contradicted by as much.

    python bench/studies/references.py --seeds 3 --output references_cpu
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import recordings
from common import make_parser, note, parse, publish, table

from gpusense.evaluation.tracking import coverage_report

NATS = 100.0
LOGS = (*recordings.CARMEN, "intel-raw", "olin", "jarvis-s3000", "jarvis-nav350")


def gains(recording, model, track):
    """Return the gain in log p of each scan at the estimate over the reference [nats]; NaN without a reference."""
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


COLUMNS = (
    "log", "references", "contradicted", "farthest", "estimates contradicted", "coverage 50, 80, 95 %, all",
    "without them",
)  # fmt: skip


def cells(r):
    """Format the cells of a row."""
    both = (", ".join(f"{value:.2f}" for value in r["coverage"][which]) for which in ("all", "others"))
    farthest = f"{r['farthest_cm']:.0f} cm, {r['farthest_deg']:.1f} deg"
    return r["log"], r["references"], r["contradicted"], farthest, r["estimates_contradicted"], *both


def main() -> None:
    parser = make_parser(__doc__, backend="opencl", seed=False)
    parser.add_argument("--logs", nargs="+", default=list(LOGS), choices=LOGS)
    parser.add_argument("--particles", type=int, default=2000)
    parser.add_argument("--seeds", type=int, default=3)
    args = parse(parser)
    rows = []
    for name in args.logs:
        rows.append(study(name, args.backend, args.particles, args.seeds))
        note(str(cells(rows[-1])))
    publish(__file__, args, table(COLUMNS, map(cells, rows)), dict(results=rows))


if __name__ == "__main__":
    main()
