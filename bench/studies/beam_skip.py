"""Do skipped beams help among people? Logs with added people, with and without beam_skip.

People stand at 0.4 to 2 m and cover sectors of the scan; sectors and distances follow random walks. A reading is the
distance of the wall or of the person, whichever is nearer. A run is lost if the median error of its last tenth is above
1 m.

    python bench/studies/beam_skip.py --output beam_skip_cpu
"""

from __future__ import annotations

import dataclasses
import itertools
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import recordings
from common import make_parser, note, parse, publish, table

# Description: number of people, degrees that each covers.
PEOPLE = {"none": (0, 0), "a person": (1, 20), "3 people": (3, 20), "a group": (1, 45)}
COLUMNS = (
    "log", "people", "temperature", "beam_skip", "median, 95 % error [cm]", "lost", "coverage 50, 80, 95 %", "ms"
)  # fmt: skip


def crowded(recording, count, degrees, seed):
    """Return a recording with added people."""
    if not count:
        return recording
    rng, bearings = np.random.default_rng(seed), np.degrees(recording.places[0][1].bearings)
    low, high = bearings.min(), bearings.max()
    at, near = rng.uniform(low, high, count), rng.uniform(0.4, 2.0, count)
    events = []
    for event in recording.events:
        at = np.clip(at + rng.normal(0, 5, count), low, high)
        near = np.clip(near + rng.normal(0, 0.1, count), 0.4, 2.0)
        hit = np.abs(bearings[:, None] - at) < degrees / 2
        wall = np.where(hit, near, np.inf).min(axis=1) + rng.normal(0, 0.02, len(bearings))
        events.append(dataclasses.replace(event, ranges=np.fmin(event.ranges, wall)))
    return dataclasses.replace(recording, events=events)


def main() -> None:
    parser = make_parser(__doc__, backend="opencl", seed=False)
    parser.add_argument("--logs", nargs="+", default=["intel", "csail"], choices=list(recordings.CARMEN))
    parser.add_argument("--skip", nargs="+", type=float, default=[0.0, 0.1, 0.3], help="beam_skip; 0 for none")
    parser.add_argument("--temperatures", nargs="+", default=["auto"])
    parser.add_argument("--particles", type=int, default=500)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--limit", type=int, default=200, help="scans of each log")
    args = parse(parser)
    results, lines = [], []
    for name in args.logs:
        recording = recordings.load(name)
        models = recording.models(recordings.field(args.backend))
        for words, temperature, skip in itertools.product(PEOPLE, args.temperatures, args.skip):
            options = dict(limit=args.limit, particles=args.particles, beam_skip=skip or None)
            options["temperature"] = temperature if temperature == "auto" else float(temperature)
            runs = [
                recordings.follow(crowded(recording, *PEOPLE[words], seed), models, seed=seed, **options)
                for seed in range(args.seeds)
            ]
            r = dict(log=name, people=words, chosen=temperature, skip=skip) | recordings.figures(runs)
            results.append(r)
            lines.append((
                name, words, temperature, skip or "none", recordings.error_cell(r), f"{r['lost']} of {r['seeds']}",
                recordings.coverage_cell(r), f"{r['ms']:.1f}",
            ))  # fmt: skip
            note(str(lines[-1]))
    publish(__file__, args, table(COLUMNS, lines), dict(results=results))


if __name__ == "__main__":
    main()
