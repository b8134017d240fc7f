"""Recorded runs with maps and reference poses for studies of localisation.

A run is a list of events in order of time: a scan of one scanner, the odometry, and the reference pose.
"""

from __future__ import annotations

import math
import multiprocessing
import os
import time
import warnings
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import gpusense as gs
from gpusense.evaluation.log_steps import read_steps
from gpusense.evaluation.tracking import START, coverage_report, rank_of

CARMEN = {name: name for name in ("intel", "csail", "aces", "belgioioso", "fhw", "seattle")} | {"fr079": "freiburg-079"}
JARVIS = ("jarvis-s3000", "jarvis-nav350", "jarvis-fused")
NAMES = (*CARMEN, "intel-raw", *JARVIS, "olin")


@dataclass(frozen=True)
class Event:
    """A scan: index of its scanner, readings [m], odometry and reference pose of the robot [m, m, rad].

    A reference pose is NaN where none is known.
    """

    scanner: int
    ranges: np.ndarray
    odometry: np.ndarray
    truth: np.ndarray


@dataclass(frozen=True)
class Recording:
    """A run: a map and a geometry for each scanner, and events."""

    name: str
    places: list
    events: list

    def models(self, make):
        """Return a model for each scanner: ``make(grid, scanner)``."""
        return [make(grid, scanner) for grid, scanner in self.places]


def data():
    return Path(os.environ["GPUSENSE_DATA"])


def load(name):
    """Return a recording by its name."""
    if name in CARMEN:
        return _carmen(name)
    if name == "intel-raw":
        return _intel_raw()
    return _olin() if name == "olin" else _jarvis(name)


def _carmen(name):
    """Return the odd scans of a CARMEN log in the map of the even ones, with raw odometry from the ODOM lines."""
    folder = data() / "carmen_logs"
    grid = gs.read_map(folder / "derived_maps" / f"{CARMEN[name]}_even_05cm.yaml")
    steps = read_steps(folder / f"{CARMEN[name]}-corrected.log.gz", every=2, offset=1)
    events = [Event(0, s.scan.ranges, np.array(s.odometry), np.array(s.scan.pose)) for s in steps]
    return Recording(name, [(grid, steps[0].scan.scanner)], events)


def _intel_raw():
    """Return every scan of the raw log in the map of the even corrected scans.

    References are the odd corrected scans that are also in the raw log; the run begins with the first of them.
    """
    folder = data() / "carmen_logs"
    grid = gs.read_map(folder / "derived_maps" / "intel_even_05cm.yaml")
    steps = read_steps(folder / "intel-rawodom-every5.log.gz", range_max=81.83)
    matches = np.loadtxt(folder / "intel-rawodom-matches.csv", delimiter=",", skiprows=1)
    truth = {int(raw): pose for raw, corrected, *pose in matches if int(corrected) % 2 == 1}
    unknown = np.full(3, np.nan)
    events = [
        Event(0, s.scan.ranges, np.array(s.odometry), np.array(truth.get(s.index, unknown)))
        for s in steps
        if s.index >= min(truth)
    ]
    return Recording("intel-raw", [(grid, steps[0].scan.scanner)], events)


def _jarvis(name):
    """Return the complex run, with references from reflectors; its 3 cm maps are built from the same run at these
    poses."""
    folder = data() / "jarvis_lab"
    run = np.load(folder / "jarvis_complex_path_fast.npz")
    mounts = {"s3000": ((0.895, 0.0, 0.0), 50.0), "nav350": ((0.194, 0.0, 0.0), 250.0)}
    chosen = list(mounts) if name == "jarvis-fused" else [name.removeprefix("jarvis-")]
    places, rows = [], []
    for index, which in enumerate(chosen):
        ranges, (mount, far) = run[f"{which}_ranges"].astype(float), mounts[which]
        # 0 and readings at the end of the scale mean no return.
        ranges[(ranges <= 0) | ~np.isfinite(ranges)] = np.inf
        far = min(far, float(ranges[np.isfinite(ranges)].max()) + 1)
        scanner = gs.Scanner.uniform(
            angle_min=float(run[f"{which}_angle_min"]), angle_increment=float(run[f"{which}_angle_inc"]),
            count=ranges.shape[1], range_max=far, mount=mount,
        )  # fmt: skip
        places.append((gs.read_map(folder / f"jarvis_{which}_from_complex_03cm.yaml"), scanner))
        valid = run[f"{which}_gt_valid"].astype(bool)
        for k in np.flatnonzero(valid):
            event = Event(index, ranges[k], run[f"{which}_odom_pose"][k], run[f"{which}_gt_pose"][k])
            rows.append((float(run[f"{which}_stamp"][k]), event))
    rows.sort(key=lambda row: row[0])
    return Recording(name, places, [event for _, event in rows])


def _olin():
    """Return every scan of the bag; its reference was refined in the same map, so it is not independent."""
    folder = data() / "olin_mac_bag"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # free_thresh frees unknown cells, which do not matter to a field.
        grid = gs.read_map(folder / "mac_1st_floor_9_23.yaml")
    reference = np.loadtxt(folder / "derived_reference.csv", delimiter=",", skiprows=1)
    scans = list(gs.read_log(folder / "macfirst_floor_take_2", range_max=12.0))
    events, first = [], np.array(scans[0].odometry)
    for scan in scans:
        k = int(np.argmin(np.abs(reference[:, 0] - scan.time)))
        if abs(reference[k, 0] - scan.time) < 0.02:
            events.append(Event(0, scan.ranges, gs.pose_difference(first, scan.odometry), reference[k, 1:4]))
    return Recording("olin", [(grid, scans[0].scanner)], events)


def wean(log):
    """Return a log of wean_hall, without reference poses."""
    folder = data() / "wean_hall"
    steps = read_steps(folder / f"{log}.log.gz")
    events = [Event(0, s.scan.ranges, np.array(s.odometry), np.full(3, np.nan)) for s in steps]
    return Recording(log, [(gs.read_map(folder / "wean_10cm.yaml"), steps[0].scan.scanner)], events)


def field(backend, **options):
    """Return a maker of the default likelihood field."""
    return lambda grid, scanner: gs.LikelihoodFieldModel(grid, scanner, backend=backend, **options)


# Parameters of a beam model: a scanner with a deviation of a few centimetres among people.
BEAM = dict(z_hit=0.7, z_short=0.1, z_max=0.05, z_rand=0.15, sigma_hit=0.07, lambda_short=0.5)


def makers(kind, backend, beams):
    """Return a maker of models of a kind: ``make(grid, scanner)``."""
    if kind == "field":
        return field(backend, beams=beams)
    if kind == "wide":
        wide = gs.LikelihoodFieldParameters()
        return lambda grid, scanner: gs.LikelihoodFieldModel(grid, scanner, wide, backend=backend, beams=beams)
    parameters = gs.BeamParameters(**BEAM)

    def make(grid, scanner):
        chosen = parameters
        if kind == "discrete":
            bins = min(int(np.ceil(scanner.range_max / 0.05)), 2000)
            chosen = gs.DiscreteBeamModel(parameters, range_max=scanner.range_max, bins=bins)
        return gs.BeamModel(grid, scanner, chosen, backend=backend, beams=beams)

    return make


@dataclass
class Followed:
    """A filter's track: errors of the estimates, covariances, ranks of the references, verdicts, times [ms]."""

    differences: np.ndarray
    covariances: np.ndarray
    ranks: np.ndarray
    lost: np.ndarray
    temperatures: np.ndarray
    ms: np.ndarray

    def with_reference(self):
        """Return the scans that have a reference pose."""
        known = np.isfinite(self.differences).all(axis=1)
        return Followed(**{name: values[known] for name, values in vars(self).items()})


def simulated_events(run):
    """Return the events of a run of ``gs.worlds.simulate_run``."""
    return [Event(0, *one) for one in zip(run.scans, run.odometry, run.poses, strict=True)]


def play(pf, models, events):
    """Move and correct a filter by each event in turn, and yield the event."""
    for before, event in zip([None, *events], events, strict=False):
        if before is not None:
            pf.predict(before.odometry, event.odometry)
        pf.correct({models[event.scanner]: event.ranges})
        yield event


def start_at(pf, pose):
    """Start a filter from a normal density around a pose, or anywhere on the map for None."""
    if pose is None:
        pf.initialize_uniform()
    else:
        pf.initialize(mean=pose, covariance=np.diag(np.square(START)))


def errors(pose, truth):
    """Return the distance [m] and the turn [rad] between two poses."""
    return math.hypot(pose[0] - truth[0], pose[1] - truth[1]), abs(math.remainder(pose[2] - truth[2], math.tau))


def follow(recording, models, *, limit=None, **options):
    """Track a recording from a normal density around the first reference pose; ranks need all particles."""
    pf = gs.ParticleFilter(models, **options)
    events = recording.events[:limit]
    start_at(pf, events[0].truth)
    rows, begin = [], time.perf_counter()
    for event in play(pf, models, events):
        found = pf.estimate()
        ms = (time.perf_counter() - begin) * 1000
        d = found.pose - event.truth
        d[2] = gs.wrap_angle(d[2])
        rank = rank_of(pf.host_particles(), pf.host_weights(), event.truth)
        rows.append((d, found.covariance, rank, found.lost, found.temperature, ms))
        begin = time.perf_counter()
    return Followed(*(np.array(column) for column in zip(*rows, strict=True)))


def figures(tracks):
    """Return the figures of several tracks of one setting; the first 5 % of a track count only for errors."""
    known = [t.with_reference() for t in tracks]
    late = [slice(len(t.ms) // 20, None) for t in known]
    reports = [
        coverage_report(t.differences[s], t.covariances[s], t.ranks[s]) for t, s in zip(known, late, strict=True)
    ]
    errors = [np.hypot(*t.differences[:, :2].T) for t in known]
    result = dict(
        seeds=len(tracks), scans=len(tracks[0].ms), references=len(errors[0]),
        median_cm=100 * float(np.median([np.median(e) for e in errors])),
        p95_cm=100 * float(np.median([np.percentile(e, 95) for e in errors])),
        heading_deg=float(np.degrees(np.median([np.median(np.abs(t.differences[:, 2])) for t in known]))),
        lost=int(sum(np.median(e[-max(len(e) // 10, 1) :]) > 1 for e in errors)),
        said_lost=float(np.mean([t.lost.mean() for t in tracks])),
        temperature=float(np.median([np.median(t.temperatures) for t in tracks])),
        ms=float(np.median([np.median(t.ms) for t in tracks])),
    )  # fmt: skip
    for key in reports[0]:
        result[key] = np.mean([r[key] for r in reports], axis=0).round(4).tolist()
    return result


def coverage_cell(row):
    """Format the coverage of the regions of 50, 80 and 95 %."""
    return ", ".join(f"{row[f'coverage_{k}']:.2f}" for k in (50, 80, 95))


def error_cell(row):
    """Format the median error and the 95 % quantile [cm]."""
    return f"{row['median_cm']:.1f}, {row['p95_cm']:.1f}"


# PoCL reads the first of these up to version 5, the second one since then.
_ONE_THREAD = ("POCL_MAX_PTHREAD_COUNT", "POCL_CPU_MAX_CU_COUNT")


def results(function, jobs, processes=1):
    """Yield ``function(*job)`` of each job, in their order; of several processes each has one thread."""
    if processes == 1:
        yield from (function(*job) for job in jobs)
        return
    for name in _ONE_THREAD:
        os.environ.setdefault(name, "1")
    # Devices do not survive a fork.
    with ProcessPoolExecutor(processes, mp_context=multiprocessing.get_context("spawn")) as pool:
        waiting = [pool.submit(function, *job) for job in jobs]
        yield from (one.result() for one in waiting)
