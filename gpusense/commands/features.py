"""Run ``gpusense features``: extract features from the scans of a log, and make landmarks."""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import gpusense as gs
from gpusense.commands import output
from gpusense.commands.arguments import Options, csv_file, picture, positive_number, refuse, whole_number
from gpusense.commands.output import counted, draw, write_table
from gpusense.commands.scans import add_log, read_posed_steps
from gpusense.commands.signals import working
from gpusense.evaluation import log_steps
from gpusense.features import feature_map
from gpusense.features import result as feature_result

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
    scans = log_steps.with_poses(steps, args.log) if posed else [(step.index, step.scan) for step in steps]
    parts: list[gs.Features] = []
    begun = time.perf_counter()
    with working(parts, len(scans)) as step:
        for first in range(0, len(scans), _CALL):
            parts.append(_extract(args, scans[first : first + _CALL]))
            for index, _ in scans[first : first + _CALL]:
                step(f"scan {index}")
    _report(args, scans, parts, posed, time.perf_counter() - begun)
    return 0


def _extract(args: argparse.Namespace, scans: list[tuple[int, gs.Scan]]) -> gs.Features:
    ranges = np.array([scan.ranges for _, scan in scans])
    kinds, scanner = args.kinds or feature_result.KINDS, scans[0][1].scanner
    light = [np.full(ranges.shape[1], np.nan) if scan.intensities is None else scan.intensities for _, scan in scans]
    noise: Any = "auto" if args.noise is None else args.noise
    return gs.extract_features(ranges, scanner, kinds, args.backend, noise=noise, intensities=np.array(light))


def _of_map(args: argparse.Namespace) -> int:
    """Make landmarks from a map."""
    refuse(args, ("out", "plot", "reference"), "must not be given with --map-in, which has no scans")
    grid = gs.read_map(args.map_in)
    landmarks = gs.landmarks_of_map(grid, kinds=_kinds(args, feature_map.MAP_KINDS), backend=args.backend)
    rows = _write_landmarks(args, landmarks, grid)
    if args.json:
        output.report({"landmarks": rows}, args)
        return 0
    output.result(f"{counted(len(rows), 'landmark')} in the map: {_counts_text(landmarks.kind)}")
    output.files(args.map_out, args.map_plot)
    return 0


def _report(
    args: argparse.Namespace, scans: list[tuple[int, gs.Scan]], parts: list[gs.Features], posed: bool, seconds: float
) -> None:
    """Print and write the features of all scans, or of the scans before an interrupt."""
    from gpusense.plots.features import features_figure

    features, done, rows = feature_result.joined(parts, _CALL), min(_CALL * len(parts), len(scans)), None
    if posed:
        poses = np.array([scan.pose for _, scan in scans[:done]])
        landmarks = gs.map_features(features, poses, kinds=_kinds(args, feature_map.MAP_KINDS), least=args.least)
        rows = _write_landmarks(args, landmarks, None)
    deviations = np.sqrt(np.einsum("fii->fi", features.covariance))
    index = np.array([index for index, _ in scans])[features.scan]
    columns = (index, features.kind, *features.pose.T, *deviations.T, features.size, features.score)
    write_table(args.out, **dict(zip(_COLUMNS, columns, strict=True)))
    most = int(np.bincount(features.scan, minlength=done).argmax())
    shown = scans[most][1]
    draw(args.plot, lambda: features_figure(features.of_scan(most), shown.ranges, shown.scanner))
    counts, each = _counts(features.kind), 1e3 * seconds / done
    if args.json:
        output.report({"scans": done, "counts": counts, "milliseconds_each": each, "landmarks": rows}, args)
        return
    total = len(features.kind)
    output.result(f"{counted(total, 'feature')} in {counted(done, 'scan')}: {total / done:.2g} a scan")
    if counts:
        output.fact("a scan", ", ".join(f"{kind} {count / done:.2g}" for kind, count in counts.items()))
    if rows is not None:
        made = f"{len(rows)}, each in {args.least} scans or more: {_counts_text(landmarks.kind)}"
        output.fact("landmarks", made)
    output.interrupted(done, len(scans))
    output.files(args.out, args.map_out, args.plot, args.map_plot)
    output.details(args, f"{each:.3g} ms each with the first call's compilation")


def _kinds(args: argparse.Namespace, every: Sequence[str]) -> tuple[str, ...]:
    return tuple(kind for kind in every if args.kinds is None or kind in args.kinds)


def _counts(kinds: np.ndarray) -> dict[str, int]:
    return dict(zip(*(values.tolist() for values in np.unique(kinds, return_counts=True)), strict=True))


def _counts_text(kinds: np.ndarray) -> str:
    return ", ".join(counted(count, kind) for kind, count in _counts(kinds).items()) or "none"


def _write_landmarks(args: argparse.Namespace, landmarks: gs.FeatureMap, grid: Any) -> list[dict[str, Any]]:
    """Write and draw landmarks, if requested, and return their rows for ``--json``."""
    from gpusense.plots.features import landmarks_figure

    if args.map_out is not None:
        landmarks.save(args.map_out)
    draw(args.map_plot, lambda: landmarks_figure(landmarks, grid))
    columns = (landmarks.kind.tolist(), landmarks.pose, landmarks.size, landmarks.count)
    return [dict(zip(("kind", "pose", "size", "count"), row, strict=True)) for row in zip(*columns, strict=True)]
