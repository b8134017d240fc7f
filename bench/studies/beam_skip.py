"""Do skipped beams help among people? Logs with people added, with beam_skip and without.

People are at 0.4 to 2 m and cover sectors of the scan; sectors and distances follow random walks. A reading is the
nearer one of wall and person. A run is lost if the median error of its last tenth is above 1 m.

    python bench/studies/beam_skip.py --out beam_skip_cpu.json
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import recordings

from gpusense.evaluation.machine import machine, machine_line

# Words; number of people; degrees that each covers.
PEOPLE = {"none": (0, 0), "a person": (1, 20), "3 people": (3, 20), "a group": (1, 45)}


def crowded(recording, count, degrees, seed):
    """Return a recording with people in it."""
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
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backend", default="opencl")
    parser.add_argument("--logs", nargs="+", default=["intel", "csail"], choices=list(recordings.CARMEN))
    parser.add_argument("--skip", nargs="+", type=float, default=[0.0, 0.1, 0.3], help="beam_skip; 0 for none")
    parser.add_argument("--temperatures", nargs="+", default=["auto"])
    parser.add_argument("--particles", type=int, default=500)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--limit", type=int, default=200, help="scans of each log")
    parser.add_argument("--out", type=Path, help="a .json file; the table goes to the .md file beside it")
    args = parser.parse_args()
    results, lines = [], [
        "| log | people | temperature | beam_skip | median, 95 % error [cm] | lost | coverage 50, 80, 95 % | ms |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]  # fmt: skip
    for name in args.logs:
        recording = recordings.load(name)
        models = recording.models(recordings.field(args.backend))
        for words, (count, degrees) in PEOPLE.items():
            for temperature in args.temperatures:
                for skip in args.skip:
                    options = dict(limit=args.limit, particles=args.particles, beam_skip=skip or None)
                    options["temperature"] = temperature if temperature == "auto" else float(temperature)
                    runs = [
                        recordings.follow(crowded(recording, count, degrees, seed), models, seed=seed, **options)
                        for seed in range(args.seeds)
                    ]
                    r = dict(log=name, people=words, chosen=temperature, skip=skip) | recordings.figures(runs)
                    results.append(r)
                    coverage = ", ".join(f"{r[f'coverage_{k}']:.2f}" for k in (50, 80, 95))
                    lines.append(
                        f"| {name} | {words} | {temperature} | {skip or 'none'} | {r['median_cm']:.1f}, "
                        f"{r['p95_cm']:.1f} | {r['lost']} of {r['seeds']} | {coverage} | {r['ms']:.1f} |"
                    )
                    print(lines[-1], flush=True)
    if args.out is not None:
        command = " ".join(["bench/studies/beam_skip.py", *sys.argv[1:]])
        args.out.write_text(json.dumps(dict(machine=machine(), command=command, results=results), indent=1))
        table = "\n".join(lines)
        args.out.with_suffix(".md").write_text(f"{machine_line()}\n\n`python {command}`\n\n{table}\n")


if __name__ == "__main__":
    main()
