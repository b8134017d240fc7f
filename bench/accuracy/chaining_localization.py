"""Localise a robot on the map that a chain of scans made, and on the map of the data folder.

    python bench/accuracy/chaining_localization.py --backend opencl --output bench/results/chaining_localization

All scans of a log are chained, and its even scans make a map at the poses of the chain, "made". The odd scans, which
are in no map, correct a particle filter with the defaults of ``gpusense localize``, which starts around the pose of the
first odd scan. "given" is the map of the data folder, made by another program of the even scans at the corrected poses
of the log (of all scans for jarvis). "at references" is made of the same scans at the same poses by ``build_map``, so
that it differs from "made" only in its poses.

"on the map" are distances from the poses at which the map was made: the references for "given" and "at references",
those of the chain for "made". They measure how well a robot finds its place on each map. "against references" are
distances from the references after the best rigid alignment of each track. They include the distortion of the made map
against the references, and so the errors of the chain and of the references. "over 5 m" and "over 20 m" are errors of
relative poses over this length of the path against the references, "-" where the track is shorter. The first 5 % of
each track are left out. Figures are medians over the seeds of the median and of the 95 % quantile.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import gpusense as gs
from gpusense.evaluation.tracking import START
from gpusense.localization.defaults import DEFAULTS

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parent))

from chaining import LIMIT, ends_of_paths, figures
from chaining_logs import Log, load, references
from common import make_parser, note, parse, publish, table

MAPS = {
    "fr079": "carmen_logs/derived_maps/freiburg-079_even_05cm.yaml",
    "csail": "carmen_logs/derived_maps/csail_even_05cm.yaml",
    "aces": "carmen_logs/derived_maps/aces_even_05cm.yaml",
    "fhw": "carmen_logs/derived_maps/fhw_even_05cm.yaml",
    "seattle": "carmen_logs/derived_maps/seattle_even_05cm.yaml",
    "jarvis-s3000": "jarvis_lab/jarvis_s3000_from_complex_03cm.yaml",
    "jarvis-nav350": "jarvis_lab/jarvis_nav350_from_complex_03cm.yaml",
}
LENGTHS = (5.0, 20.0)
KEYS = ("on_the_map_m", "against_references_m", "over_5_m", "over_20_m")


def part(log: Log, begin: int) -> Log:
    """Return every second scan of a log."""
    times = None if log.times is None else log.times[begin::2]
    return replace(
        log, ranges=log.ranges[begin::2], odometry=log.odometry[begin::2], truth=log.truth[begin::2], times=times
    )


def tracked(grid: gs.OccupancyGrid, log: Log, start: np.ndarray, seed: int, backend: str) -> np.ndarray:
    """Return the poses of a particle filter."""
    model = gs.LikelihoodFieldModel(
        grid, log.scanner, gs.LikelihoodFieldParameters(**DEFAULTS.field), beams=DEFAULTS.beams, backend=backend
    )
    pf = gs.ParticleFilter(model, particles=DEFAULTS.particles, seed=seed)
    pf.initialize(mean=start, covariance=np.diag(np.square(START)))
    poses = []
    for k, (ranges, odometry) in enumerate(zip(log.ranges, log.odometry, strict=True)):
        if k:
            pf.predict(log.odometry[k - 1], odometry)
        pf.correct(ranges)
        poses.append(pf.estimate().pose)
    return np.array(poses)


def aligned(poses: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return distances (S,) after the best rigid alignment [m]."""
    p, q = poses[:, :2] @ (1, 1j), truth[:, :2] @ (1, 1j)
    p, q = p - p.mean(), q - q.mean()
    turn = np.vdot(p, q)
    return np.abs(p * turn / abs(turn) - q)


def over_length(poses: np.ndarray, truth: np.ndarray, length: float) -> np.ndarray:
    """Return errors (P,) of relative poses over a path of a length [m]; none where the track is shorter."""
    first, second, _ = ends_of_paths(truth, length)
    moved = [gs.pose_difference(p[first], p[second]) for p in (truth, poses)]
    return np.hypot(*(gs.pose_difference(*moved))[:, :2].T)


def quantiles(errors: np.ndarray) -> list[float]:
    """Return the median and the 95 % quantile; NaN where there are no errors."""
    return np.percentile(errors, [50, 95]).tolist() if len(errors) else [np.nan, np.nan]


def measured(log: Log, name: str, arguments: Any) -> list[dict[str, Any]]:
    """Return the rows of a log: on each map."""
    even, odd = part(log, 0), part(log, 1)
    chain = gs.chain_scans(
        log.ranges, odometry=log.odometry, times=log.times, backend=arguments.backend, **log.arguments
    )
    shift = figures(log, "", chain.poses, 0.0)["earlier_s"]
    mapped, truth = references(even, shift), references(odd, shift)
    given = gs.read_map(Path(arguments.data) / MAPS[name])
    options = {"resolution": given.resolution, "range_limit": LIMIT, "backend": arguments.backend}
    known = np.flatnonzero(np.isfinite(mapped).all(axis=1))
    moved = None if chain.motions is None else chain.motions[::2]
    maps = {
        "given": given,
        "at references": gs.build_map(
            even.ranges[known], mapped[known], log.scanner, motion=None if moved is None else moved[known], **options
        ),
        "made": gs.build_map(even.ranges, chain.poses[::2], log.scanner, motion=moved, **options),
    }
    chosen = np.flatnonzero(np.isfinite(truth).all(axis=1))[: arguments.scans]
    runs, true = slice(int(chosen[0]), int(chosen[-1]) + 1), truth[chosen]
    some = replace(odd, ranges=odd.ranges[runs], odometry=odd.odometry[runs])
    placed = {"given": true, "at references": true, "made": chain.poses[1::2][chosen]}
    late = slice(len(chosen) // 20, None)
    rows = []
    for kind, grid in maps.items():
        found = []
        for seed in range(arguments.seeds):
            poses = tracked(grid, some, placed[kind][0], seed, arguments.backend)[chosen - chosen[0]]
            off = np.hypot(*(poses - placed[kind])[late, :2].T)
            errors = [off, aligned(poses[late], true[late])]
            errors += [over_length(poses[late], true[late], length) for length in LENGTHS]
            found.append([quantiles(values) for values in errors])
        median = [[None if np.isnan(value) else float(value) for value in both] for both in np.median(found, axis=0)]
        rows.append({"log": name, "map": kind, "held_out": len(chosen)} | dict(zip(KEYS, median, strict=True)))
        note(f"{name}, {kind}: {median}")
    return rows


def main(argv: list[str] | None = None) -> None:
    """Measure, and publish a table."""
    parser = make_parser(__doc__, backend="auto", data=True)
    parser.add_argument("--log", action="append", choices=MAPS, help="default: all")
    parser.add_argument("--seeds", type=int, default=3, help="runs on each map (default: %(default)s)")
    parser.add_argument("--scans", type=int, default=1000, help="most held-out scans (default: %(default)s)")
    arguments = parse(parser, argv)
    rows = []
    for name in arguments.log or MAPS:
        rows += measured(load(Path(arguments.data), name), name, arguments)
    columns = ["log", "scans", "map", "on the map: median, 95 % cm", "against references", "over 5 m", "over 20 m"]
    lines = [
        [row["log"], row["held_out"], row["map"],
         *("-" if row[key][0] is None else f"{100 * row[key][0]:.1f}, {100 * row[key][1]:.1f}" for key in KEYS)]
        for row in rows
    ]  # fmt: skip
    publish(__file__, arguments, table(columns, lines), {"rows": rows})


if __name__ == "__main__":
    main()
