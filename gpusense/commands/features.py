"""Run ``gpusense features``: extract features from the scans of a log, and make landmarks."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np

from gpusense.commands import output
from gpusense.commands.arguments import Options, csv_file, picture, positive_number, whole_number
from gpusense.commands.output import counted, draw, write_table
from gpusense.commands.scans import add_log, read_posed_steps
from gpusense.commands.signals import working
from gpusense.evaluation.steps import with_poses
from gpusense.features.extract import extract_features
from gpusense.features.feature_map import MAP_KINDS, FeatureMap
from gpusense.features.landmarks import landmarks_of_map, map_features
from gpusense.features.result import KINDS, Features, joined
from gpusense.logs import Scan
from gpusense.plots.features import features_figure, landmarks_figure
from gpusense.world.map_files import read_map

FIRST = ("log", "reference", "kinds", "map_out", "plot")
SHARED = ("reference", "choice", "backend", "verbose")

_COLUMNS = (
    "scan", "kind", "x", "y", "theta", "deviation_x", "deviation_y", "deviation_theta", "size", "score",
)  # fmt: skip
_KINDS = ("line", "corner", "door", "hallway", "pole", "reflector")
# Scans per call and step of the progress bar.
_CALL = 256

EPILOG = """\
Each scan is split into lines, which form corners, doors, hallways and poles (docs/landmarks.md). --map-out makes a map
of the lines, corners, doors, poles and reflectors of all scans, at the poses of the log or of --reference; --map-in
makes a map from an occupancy grid instead. Reflectors need a log with intensities.

examples:
  gpusense features --log run.log.gz --limit 300 --plot scan.png
  gpusense features --log run.log.gz --map-out landmarks.csv \\
      --map-plot landmarks.png
  gpusense features --map-in map.yaml --map-out landmarks.csv"""


def add_options(add: Options) -> None:
    """Add the command's options."""
    add_log(add, "a log with scans", required=False)
    add("--map-in YAML", "a map_server map from which landmarks are made, instead of a log", Path)
    add("--kinds KIND...", f"{', '.join(_KINDS)} (default: all)", _KINDS)
    add("--noise M", "standard deviation of ranges [m] (default: by each scan)", positive_number)
    add("--least N", "smallest number of scans that must show a landmark", whole_number(low=1), 2)
    add("--out CSV", "write all features", csv_file)
    add("--map-out CSV", "write landmarks", csv_file)
    add("--plot FILE", "draw the scan with the most features", picture)
    add("--map-plot FILE", "draw the landmarks", picture)


def run(args: argparse.Namespace) -> int:
    """Extract the features and print their numbers; after Ctrl-C, the features so far."""
    if (args.log is None) == (args.map_in is None):
        raise ValueError("--log: must be given, or else --map-in, and not both")
    if args.map_in is not None:
        return _of_map(args)
    posed = args.map_out is not None or args.map_plot is not None
    steps = read_posed_steps(args)
    scans = with_poses(steps, args.log) if posed else [(step.index, step.scan) for step in steps]
    parts: list[Features] = []
    begun = time.perf_counter()
    with working(parts, len(scans)) as step:
        for first in range(0, len(scans), _CALL):
            parts.append(_extract(args, scans[first : first + _CALL]))
            for index, _ in scans[first : first + _CALL]:
                step(f"scan {index}")
    _report(args, scans, parts, posed, time.perf_counter() - begun)
    return 0


def _extract(args: argparse.Namespace, scans: list[tuple[int, Scan]]) -> Features:
    ranges = np.array([scan.ranges for _, scan in scans])
    kinds, scanner = args.kinds or KINDS, scans[0][1].scanner
    light = [np.full(ranges.shape[1], np.nan) if scan.intensities is None else scan.intensities for _, scan in scans]
    noise: Any = "auto" if args.noise is None else args.noise
    return extract_features(ranges, scanner, kinds, args.backend, noise=noise, intensities=np.array(light))


def _landmark_kinds(args: argparse.Namespace) -> tuple[str, ...]:
    return tuple(kind for kind in MAP_KINDS if args.kinds is None or kind in args.kinds)


def _of_map(args: argparse.Namespace) -> int:
    """Make landmarks from a map."""
    for option in ("out", "plot", "reference"):
        if getattr(args, option) is not None:
            raise ValueError(f"--{option}: must not be given with --map-in, which has no scans")
    grid = read_map(args.map_in)
    landmarks = landmarks_of_map(grid, kinds=_landmark_kinds(args), backend=args.backend)
    _write_landmarks(args, landmarks, grid)
    if args.json:
        output.report({"landmarks": _landmark_rows(landmarks)}, args)
        return 0
    output.result(f"{counted(len(landmarks.kind), 'landmark')} in the map: {_kinds(landmarks.kind)}")
    _print_files(args)
    return 0


def _report(
    args: argparse.Namespace, scans: list[tuple[int, Scan]], parts: list[Features], posed: bool, seconds: float
) -> None:
    """Print and write the features of all scans, or of the scans before an interrupt."""
    features = joined(parts, _CALL)
    done = min(_CALL * len(parts), len(scans))
    landmarks = None
    if posed:
        poses = np.array([scan.pose for _, scan in scans[:done]])
        landmarks = map_features(features, poses, kinds=_landmark_kinds(args), least=args.least)
        _write_landmarks(args, landmarks, None)
    deviations = np.sqrt(np.einsum("fii->fi", features.covariance))
    index = np.array([index for index, _ in scans])[features.scan]
    columns = (index, features.kind, *features.pose.T, *deviations.T, features.size, features.score)
    write_table(args.out, **dict(zip(_COLUMNS, columns, strict=True)))
    most = int(np.bincount(features.scan, minlength=done).argmax())
    shown = scans[most][1]
    draw(args.plot, lambda: features_figure(features.of_scan(most), shown.ranges, shown.scanner))
    counts = {str(kind): int(count) for kind, count in zip(*np.unique(features.kind, return_counts=True), strict=True)}
    if args.json:
        rows = None if landmarks is None else _landmark_rows(landmarks)
        facts = {"scans": done, "counts": counts, "milliseconds_each": 1e3 * seconds / done, "landmarks": rows}
        output.report(facts, args)
        return
    output.result(f"{counted(len(features.kind), 'feature')} in {counted(done, 'scan')}: "
                  f"{len(features.kind) / done:.2g} a scan")  # fmt: skip
    if counts:
        output.fact("a scan", ", ".join(f"{kind} {count / done:.2g}" for kind, count in counts.items()))
    if landmarks is not None:
        output.fact("landmarks", f"{len(landmarks.kind)}, each in {args.least} scans or more: {_kinds(landmarks.kind)}")
    output.interrupted(done, len(scans))
    _print_files(args)
    output.details(args, f"{1e3 * seconds / done:.3g} ms each with the first call's compilation")


def _kinds(kinds: np.ndarray) -> str:
    """Return the number of each kind in words."""
    names, counts = np.unique(kinds, return_counts=True)
    return ", ".join(counted(int(count), str(name)) for name, count in zip(names, counts, strict=True)) or "none"


def _print_files(args: argparse.Namespace) -> None:
    output.files(args.out, args.map_out, args.plot, args.map_plot)


def _landmark_rows(landmarks: FeatureMap) -> list[dict[str, Any]]:
    return [
        {"kind": str(kind), "pose": pose, "size": float(size), "count": int(count)}
        for kind, pose, size, count in zip(landmarks.kind, landmarks.pose, landmarks.size, landmarks.count, strict=True)
    ]


def _write_landmarks(args: argparse.Namespace, landmarks: FeatureMap, grid: Any) -> None:
    if args.map_out is not None:
        landmarks.save(args.map_out)
    draw(args.map_plot, lambda: landmarks_figure(landmarks, grid))
