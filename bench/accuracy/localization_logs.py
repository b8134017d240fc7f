"""Track all recorded logs with reference poses: field, beam model and discrete model at several numbers of particles.

Every run begins with a normal density of deviations 0.5 m, 0.5 m and 0.26 rad around the first reference pose, and has
the filter's defaults. A run is lost if the median error of its last tenth is above 1 m. wean_hall has no reference:
there, starts anywhere on the map are compared with one another and with the verdict.

    python bench/accuracy/localization_logs.py --logs aces olin --models field --particles 500 5000 --seeds 3 \
        --out localization_logs_cpu.json
"""

from __future__ import annotations

import argparse
import functools
import itertools
import json
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import recordings
from parallel import results

import gpusense as gs
from gpusense.evaluation.machine import machine, machine_line
from gpusense.evaluation.steps import read_steps
from gpusense.localization.defaults import DEFAULTS


def wean(backend, seeds):
    """Return where starts anywhere on wean_hall's map end, and their verdicts."""
    folder, rows = recordings.data() / "wean_hall", []
    grid = gs.read_map(folder / "wean_10cm.yaml")
    for log in ("robotdata1", "robotdata4", "robotdata5"):
        steps = read_steps(folder / f"{log}.log.gz")
        model = recordings.field(backend, beams=60)(grid, steps[0].scan.scanner)
        for seed in range(seeds):
            pf = gs.ParticleFilter(model, particles=DEFAULTS.particles_everywhere, seed=seed)
            pf.initialize_uniform()
            estimates = []
            for before, step in zip([None, *steps], steps, strict=False):
                if before is not None:
                    pf.predict(before.odometry, step.odometry)
                pf.correct(step.scan.ranges)
                estimates.append(pf.estimate())
            found, said = estimates[-1], np.array([one.lost for one in estimates])
            row = dict(
                log=log, seed=seed, scans=len(steps), pose=found.pose.round(2).tolist(), lost=found.lost,
                explained=round(float(found.explained), 3), said_lost=round(float(said.mean()), 3),
                at={k: estimates[k].pose.round(2).tolist() for k in range(100, len(steps), 100)},
            )  # fmt: skip
            print(row, flush=True)
            rows.append(row)
    return rows


@functools.cache
def _recording(name):
    return recordings.load(name)


@functools.cache
def _motion(name):
    """Return the motion model that is learned from the odometry of a log."""
    events = _recording(name).events
    odometry, truth = (np.array([getattr(e, which) for e in events]) for which in ("odometry", "truth"))
    return gs.fit_odometry_motion(odometry, truth).motion


@functools.cache
def _models(name, kind, backend, beams):
    return _recording(name).models(recordings.makers(kind, backend, beams))


def track(name, kind, particles, seed, backend, beams, limit, fit_motion, recovery):
    """Return the track of a run."""
    motion = _motion(name) if fit_motion else None
    models = _models(name, kind, backend, beams)
    return recordings.follow(
        _recording(name), models, limit=limit, particles=particles, seed=seed, motion=motion, **recovery
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backend", default="opencl")
    parser.add_argument("--logs", nargs="+", default=list(recordings.NAMES), choices=(*recordings.NAMES, "wean"))
    parser.add_argument("--models", nargs="+", default=["field"], choices=("field", "beam", "discrete"))
    parser.add_argument("--particles", nargs="+", type=int, default=[500, 5000])
    parser.add_argument("--beams", type=int, help="thin each scan evenly to this many beams")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--limit", type=int, help="scans of each log")
    parser.add_argument("--fit-motion", action="store_true", help="learn the noise of the odometry from the log first")
    parser.add_argument("--recovery", default="default", choices=("default", "none", "augmented", "sensor"))
    parser.add_argument("--processes", type=int, default=1, help="runs at once, each with one thread")
    parser.add_argument("--out", type=Path, help="a .json file; the table goes to the .md file beside it")
    args = parser.parse_args()
    rows = wean(args.backend, args.seeds) if "wean" in args.logs else []
    recovery = {} if args.recovery == "default" else dict(recovery=None if args.recovery == "none" else args.recovery)
    settings = list(itertools.product([name for name in args.logs if name != "wean"], args.models, args.particles))
    jobs = [
        (*setting, seed, args.backend, args.beams, args.limit, args.fit_motion, recovery)
        for setting in settings
        for seed in range(args.seeds)
    ]
    tracks = results(track, jobs, args.processes)
    for name, kind, count in settings:
        noise = "fitted" if args.fit_motion else "default"
        row = dict(log=name, model=kind, particles=count, beams=args.beams, noise=noise, recovery=args.recovery)
        row |= recordings.figures(list(itertools.islice(tracks, args.seeds)))
        print(_line(row), flush=True)
        rows.append(row)
    if args.out is not None:
        command = " ".join(["bench/accuracy/localization_logs.py", *sys.argv[1:]])
        args.out.write_text(json.dumps(dict(machine=machine(), command=command, results=rows), indent=1))
        lines = [_line(row) for row in rows if "model" in row]
        if lines:
            table = "\n".join([*_HEAD, *lines])
            args.out.with_suffix(".md").write_text(f"{machine_line()}\n\n`python {command}`\n\n{table}\n")


_HEAD = (
    "| log | model | noise | particles | median, 95 % error [cm] | heading [deg] | lost | scans said lost [%] | "
    "coverage 50, 80, 95 % | temperature | ms a scan |",
    "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
)


def _line(r):
    coverage = ", ".join(f"{r[f'coverage_{k}']:.2f}" for k in (50, 80, 95))
    return (
        f"| {r['log']} | {r['model']} | {r['noise']} | {r['particles']} | {r['median_cm']:.1f}, {r['p95_cm']:.1f} | "
        f"{r['heading_deg']:.2f} | {r['lost']} of {r['seeds']} | {100 * r['said_lost']:.1f} | {coverage} | "
        f"{r['temperature']:.3f} | {r['ms']:.1f} |"
    )


if __name__ == "__main__":
    main()
