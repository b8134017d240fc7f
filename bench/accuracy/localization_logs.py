"""Track all recorded logs with reference poses: field, beam model and discrete model at several numbers of particles.

Every run begins with a normal density of deviations 0.5 m, 0.5 m and 0.26 rad around the first reference pose, and has
the filter's defaults. A run is lost if the median error of its last tenth is above 1 m. wean_hall has no reference:
its starts anywhere on the map are compared with one another and with the verdict. ``--starts`` measures starts anywhere
on the map of intel instead: they are right where the last 3 of 15 scans are within 1 m and 20 degrees.

    python bench/accuracy/localization_logs.py --logs aces olin --models field --particles 500 5000 --seeds 3 \
        --output localization_logs_cpu
    python bench/accuracy/localization_logs.py --starts 50 --start-particles 2000 5000 20000
"""

from __future__ import annotations

import functools
import itertools
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import recordings
from common import make_parser, note, parse, publish, table

import gpusense as gs
from gpusense.evaluation.tracking import CONVERGED, CONVERGED_TURN
from gpusense.localization.defaults import DEFAULTS

COLUMNS = (
    "log", "model", "noise", "particles", "median, 95 % error [cm]", "heading [deg]", "lost", "scans said lost [%]",
    "coverage 50, 80, 95 %", "temperature", "ms a scan",
)  # fmt: skip
STARTS = ("particles", "right", "ms a scan")
# Scans of a start anywhere, and the number of last ones that must be right.
SCANS, LAST = 15, 3


def wean(backend, seeds):
    """Return the last pose and the verdicts of filters that start anywhere on wean_hall's map."""
    rows = []
    for log in ("robotdata1", "robotdata4", "robotdata5"):
        recording = recordings.wean(log)
        models = recording.models(recordings.field(backend, beams=60))
        for seed in range(seeds):
            pf = gs.ParticleFilter(models, particles=DEFAULTS.particles_everywhere, seed=seed)
            pf.initialize_uniform()
            estimates = [pf.estimate() for _ in recordings.play(pf, models, recording.events)]
            found, said = estimates[-1], np.array([one.lost for one in estimates])
            row = dict(
                log=log, seed=seed, scans=len(estimates), pose=found.pose.round(2).tolist(), lost=found.lost,
                explained=round(float(found.explained), 3), said_lost=round(float(said.mean()), 3),
                at={k: estimates[k].pose.round(2).tolist() for k in range(100, len(estimates), 100)},
            )  # fmt: skip
            note(str(row))
            rows.append(row)
    return rows


def global_starts(backend, starts, particles):
    """Return how many starts anywhere on the map of intel are right after SCANS scans, and their time."""
    recording, good = recordings.load("intel"), 0
    models, begin = recording.models(recordings.field(backend)), time.perf_counter()
    for seed in range(starts):
        first = int(np.random.default_rng(seed).integers(0, len(recording.events) - SCANS))
        pf = gs.ParticleFilter(models, particles=particles, seed=seed)
        pf.initialize_uniform()
        near = []
        for event in recordings.play(pf, models, recording.events[first : first + SCANS]):
            distance, turn = recordings.errors(pf.estimate().pose, event.truth)
            near.append(distance < CONVERGED and turn < CONVERGED_TURN)
        good += all(near[-LAST:])
    ms = (time.perf_counter() - begin) / (starts * SCANS) * 1000
    return dict(name="global starts", particles=particles, runs=starts, good=good, scans=SCANS, ms=ms)


@functools.cache
def _recording(name):
    return recordings.load(name)


@functools.cache
def _motion(name):
    """Return the motion model learned from the odometry of a log."""
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


def measure_starts(args):
    """Measure and publish starts anywhere on the map of intel."""
    rows = [global_starts(args.backend, args.starts, count) for count in args.start_particles]
    lines = [(row["particles"], f"{row['good']} of {row['runs']}", f"{row['ms']:.1f}") for row in rows]
    publish(__file__, args, table(STARTS, lines), dict(results=rows), f"Starts anywhere on intel, {SCANS} scans each.")


def main() -> None:
    parser = make_parser(__doc__, backend="opencl", seed=False)
    parser.add_argument("--logs", nargs="+", default=list(recordings.NAMES), choices=(*recordings.NAMES, "wean"))
    parser.add_argument("--models", nargs="+", default=["field"], choices=("field", "wide", "beam", "discrete"))
    parser.add_argument("--particles", nargs="+", type=int, default=[500, 5000])
    parser.add_argument("--beams", type=int, help="thin each scan evenly to this many beams")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--limit", type=int, help="scans of each log")
    parser.add_argument("--fit-motion", action="store_true", help="learn the noise of the odometry from the log first")
    parser.add_argument("--recovery", default="default", choices=("default", "none", "augmented", "sensor"))
    parser.add_argument("--processes", type=int, default=1, help="runs at once, each with one thread")
    parser.add_argument("--starts", type=int, default=0, help="starts anywhere on the map of intel, in place of logs")
    parser.add_argument("--start-particles", nargs="+", type=int, default=[DEFAULTS.particles_everywhere])
    args = parse(parser)
    if args.starts:
        measure_starts(args)
        return
    rows = wean(args.backend, args.seeds) if "wean" in args.logs else []
    recovery = {} if args.recovery == "default" else dict(recovery=None if args.recovery == "none" else args.recovery)
    settings = list(itertools.product([name for name in args.logs if name != "wean"], args.models, args.particles))
    jobs = [
        (*setting, seed, args.backend, args.beams, args.limit, args.fit_motion, recovery)
        for setting in settings
        for seed in range(args.seeds)
    ]
    tracks = recordings.results(track, jobs, args.processes)
    for name, kind, count in settings:
        noise = "fitted" if args.fit_motion else "default"
        row = dict(log=name, model=kind, particles=count, beams=args.beams, noise=noise, recovery=args.recovery)
        row |= recordings.figures(list(itertools.islice(tracks, args.seeds)))
        note(str(_cells(row)))
        rows.append(row)
    publish(__file__, args, table(COLUMNS, [_cells(row) for row in rows if "model" in row]), dict(results=rows))


def _cells(r):
    return (
        r["log"], r["model"], r["noise"], r["particles"], recordings.error_cell(r), f"{r['heading_deg']:.2f}",
        f"{r['lost']} of {r['seeds']}", f"{100 * r['said_lost']:.1f}", recordings.coverage_cell(r),
        f"{r['temperature']:.3f}", f"{r['ms']:.1f}",
    )  # fmt: skip


if __name__ == "__main__":
    main()
