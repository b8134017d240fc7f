"""Classify the corners whose errors are beyond 99.9 % of chi squared, on floors of known geometry.

    python bench/accuracy/feature_outliers.py --backend opencl --output bench/results/feature_outliers_cpu

Each corner is the vertex of two segments. The beams of a segment show its wall. Causes are two walls that meet, with
none, one or several beams of other walls among theirs, and two walls that do not meet.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

import gpusense as gs
from gpusense.backends import get_backend
from gpusense.features.device import ScanDevice
from gpusense.features.segments import Segments, find_segments
from gpusense.matching.noise import scan_noise
from gpusense.matching.points import scan_points

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests"))

from accuracy.features import scanner_of
from common import make_parser, parse, publish, table
from support.feature_scenes import Floor, floor_plan
from support.feature_scores import FREE, score_scan
from support.feature_truth import truth_of

SETTINGS = ((360, 0.01), (360, 0.03), (1081, 0.01), (1081, 0.03))
CAUSES = ("walls that meet", "one beam of another wall", "several beams of other walls", "walls that do not meet")


def sides_of(segments: Segments, scan: int, vertex: np.ndarray) -> list[int]:
    """Return the segments of a scan whose lines pass through a vertex, by the distance of their ends from it."""
    near = []
    for g in np.flatnonzero((segments.scan == scan) & np.isfinite(segments.distance)).tolist():
        c, s = math.cos(segments.angle[g]), math.sin(segments.angle[g])
        if abs(c * vertex[0] + s * vertex[1] - segments.distance[g]) < 1e-6:
            near.append((float(np.abs(segments.ends[g] - (c * vertex[1] - s * vertex[0])).min()), g))
    return [g for _, g in sorted(near)][:2]


def walls_of(segments: Segments, g: int, bearing: np.ndarray, surface: np.ndarray) -> tuple[int, int]:
    """Return the wall that most beams of a segment hit, and the number of its other beams."""
    points, scan = segments.points, segments.scan[g]
    begin, total = points.start[scan], points.counts[scan]
    index = begin + (segments.first[g] - begin + np.arange(segments.count[g])) % total
    beam = np.searchsorted(bearing, np.mod(points.point[index, 2], 2 * math.pi) - 1e-6) % len(bearing)
    wall, most = Counter(surface[beam].tolist()).most_common(1)[0]
    return wall, len(beam) - most


def cause_of(floor: Floor, sides: list[tuple[int, int]]) -> str:
    """Return the cause of a corner, from its two sides."""
    (one, others), (two, more) = sides
    meet = max(one, two) < len(floor.walls) and one != two
    if meet:
        ends = [floor.walls[wall].reshape(2, 2) for wall in (one, two)]
        meet = bool((np.abs(ends[0][:, None] - ends[1]).max(axis=2) < 1e-6).any())
    return CAUSES[min(others + more, 2)] if meet else CAUSES[3]


def counted(arguments: argparse.Namespace, beams: int, noise: float) -> dict[bool, Counter[str]]:
    """Count the causes of corners within the limit and beyond it."""
    scanner, counts = scanner_of(beams), {False: Counter[str](), True: Counter[str]()}
    device = get_backend(arguments.backend)
    order = np.argsort(np.mod(scanner.bearings, 2 * math.pi))
    bearing = np.mod(scanner.bearings, 2 * math.pi)[order]
    for seed in range(arguments.floors):
        floor = floor_plan(seed)
        poses = floor.poses(arguments.scans, seed)
        exact, surface = floor.cast(poses, scanner.bearings)
        ranges = exact + noise * np.random.default_rng([seed, 3]).standard_normal(exact.shape)
        features = gs.extract_features(ranges, scanner, "corner", arguments.backend)
        deviation = np.clip(scan_noise(ranges, scanner), 3e-3, 0.1)
        points = scan_points(ranges, scanner, np.dtype(np.float64))
        real = np.dtype(np.float64 if device.info.float64 else np.float32)
        segments = find_segments(ScanDevice(device, real, points, deviation), points, deviation)
        for k in range(len(poses)):
            truth = truth_of(floor, poses[k], scanner.bearings, exact[k], surface[k])
            for corner in features.of_scan(k):
                scores: dict[str, Any] = {}
                score_scan(corner, truth, scores)
                sides = sides_of(segments, k, corner.pose[0, :2])
                if not scores["corner"].squares or len(sides) < 2:
                    continue
                outlier = scores["corner"].squares[0] > chi2.ppf(0.999, FREE["corner"]) / FREE["corner"]
                walls = [walls_of(segments, g, bearing, surface[k][order]) for g in sides]
                counts[bool(outlier)][cause_of(floor, walls)] += 1
    return counts


def main(argv: list[str] | None = None) -> None:
    """Count and write the report."""
    parser = make_parser(__doc__, backend="auto")
    parser.add_argument("--floors", type=int, default=15, help="simulated floors (default: %(default)s)")
    parser.add_argument("--scans", type=int, default=15, help="scans of each floor (default: %(default)s)")
    arguments = parse(parser, argv)
    rows, report = [], {}
    for beams, noise in SETTINGS:
        for outlier, counts in counted(arguments, beams, noise).items():
            total = sum(counts.values())
            label = "beyond" if outlier else "within"
            report[f"{beams} {noise} {label}"] = {"corners": total, **{cause: counts[cause] for cause in CAUSES}}
            shares = [f"{100 * counts[cause] / total:.0f}" if total else "" for cause in CAUSES]
            rows.append([beams, f"{100 * noise:g}", label, total, *shares])
    names = ["beams", "noise [cm]", "99.9 % of chi squared", "corners", *(f"{cause} [%]" for cause in CAUSES)]
    publish(__file__, arguments, "# Corners beyond their covariances\n\n" + table(names, rows), report)


if __name__ == "__main__":
    main()
