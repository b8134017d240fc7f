"""Measure features of scans: recall, precision, covariance, repeatability, localisation by features alone, and rates.

    python bench/accuracy/features.py --backend opencl --output bench/results/features_cpu

``GPUSENSE_DATA`` names the folder of recorded data. The parts are:

- ``simulated``: floors of known geometry (see ``tests/support/feature_scenes.py``: corridors, rooms, doors open, half
  open and closed, square pillars, poles, boxes). Recall is the share of well-visible features that are found, precision
  the share of returned features that exist. Median errors follow, the mean squared error over the covariance per degree
  of freedom (NEES; 1 is right) without errors beyond 99.9 % of chi squared, and the share of those.
- ``real``: the share of features of recorded scans that are found again from another place, and their distances in
  standard deviations. The assumed deviations of the reference poses are 3 cm and 0.01 rad (jarvis 1 cm and 0.004 rad).
- ``localisation``: a filter with points (corners, doors and poles), with lines, with both, and with the likelihood
  field. The other half of the scans makes the map.
- ``rates``: scans of 1080 beams a second.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import chi2

import gpusense as gs
from gpusense.features.result import Features

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests"))

import recordings
from common import add_repeats, best, make_parser, parse, publish, table
from support.feature_scenes import floor_plan
from support.feature_scores import FREE, Score, score_scan
from support.feature_truth import truth_of

PARTS = ("simulated", "real", "localisation", "rates")
BEAMS, NOISES = (180, 360, 1081), (0.0, 0.01, 0.03, 0.05)
# Recordings, standard deviations of their reference poses, and scans of each to compare.
RECORDINGS = {
    "intel": (0.03, 0.01), "csail": (0.03, 0.01), "olin": (0.03, 0.01), "jarvis-nav350": (0.01, 0.004),
    "jarvis-s3000": (0.01, 0.004),
}  # fmt: skip
# Motions between compared scans [m], the range of features [m], and the largest difference of equal ones [m, rad].
MOVED, FAR, NEAR, TURN = (0.3, 2.0), 8.0, 0.3, 0.35
# Kinds of features that a filter uses, and the parameters of its models.
LANDMARKS = ("corner", "door", "pole")
MAPPED = ("line", *LANDMARKS)
PARAMETERS = gs.LandmarkParameters(
    sigma_range=0.1, sigma_bearing=0.03, sigma_signature=0.3, z_detect=0.7, z_false=0.3, range_max=20.0
)
LINES = gs.LineParameters(sigma_angle=0.03, sigma_distance=0.1, z_detect=0.7, z_false=0.3, range_max=20.0)


def scanner_of(beams: int) -> gs.Scanner:
    """Return a scanner of 270 degrees with a beam every 0.25 degrees, or one of 360 degrees."""
    if beams == 1081:
        return gs.Scanner.uniform(
            angle_min=-0.75 * math.pi, angle_increment=math.radians(0.25), count=1081, range_max=25
        )
    return gs.Scanner.uniform(angle_min=-math.pi, angle_increment=2 * math.pi / beams, count=beams, range_max=25)


def scans_of(seed: int, scanner: gs.Scanner, noise: float, count: int) -> tuple[np.ndarray, list[Any]]:
    """Return scans of a floor and their true features."""
    floor = floor_plan(seed)
    poses = floor.poses(count, seed)
    exact, surface = floor.cast(poses, scanner.bearings)
    truth = [truth_of(floor, p, scanner.bearings, r, s) for p, r, s in zip(poses, exact, surface, strict=True)]
    return exact + noise * np.random.default_rng([seed, 3]).standard_normal(exact.shape), truth


def figures_of(kind: str, score: Score) -> dict[str, float]:
    """Return the figures of one kind."""
    squares = np.array(score.squares)
    limit = chi2.ppf(0.999, FREE[kind]) / FREE[kind]
    inner = squares[squares <= limit]
    return {
        "required": score.required, "recall": score.recall, "features": score.features, "precision": score.precision,
        "error_m": float(np.median(score.errors)) if score.errors else math.nan,
        "nees": float(inner.mean()) if len(inner) else math.nan,
        "nees_all": score.nees, "outliers": float(np.mean(squares > limit)) if len(squares) else math.nan,
    }  # fmt: skip


def simulated(arguments: argparse.Namespace) -> tuple[str, dict[str, Any]]:
    """Return recall, precision and covariances in floors of known geometry."""
    rows, report = [], {}
    for beams in BEAMS:
        for noise in NOISES:
            scores: dict[str, Score] = {}
            scanner = scanner_of(beams)
            for seed in range(arguments.floors):
                ranges, truth = scans_of(arguments.seed + seed, scanner, noise, arguments.scans)
                features = gs.extract_features(ranges, scanner, backend=arguments.backend)
                for k, one in enumerate(truth):
                    score_scan(features.of_scan(k), one, scores)
            for kind in FREE:
                f = figures_of(kind, scores[kind])
                report[f"{beams} {noise} {kind}"] = f
                nees = "" if noise == 0 else f"{f['nees']:.2f}"
                outliers = "" if noise == 0 else f"{100 * f['outliers']:.1f}"
                rows.append([
                    beams, f"{100 * noise:g}", kind, f"{100 * f['recall']:.1f} of {f['required']}",
                    f"{100 * f['precision']:.1f} of {f['features']}", f"{1000 * f['error_m']:.1f}", nees, outliers,
                ])  # fmt: skip
    names = ["beams", "noise [cm]", "kind", "recall [%]", "precision [%]", "error [mm], median", "NEES", "outliers [%]"]
    return "## Simulated floors\n\n" + table(names, rows), report


def expected_again(features: Features, relative: np.ndarray, ranges: np.ndarray, scanner: gs.Scanner) -> np.ndarray:
    """Return which features (F,) another scan should show: near, in its field of view, and not occluded."""
    c, s = math.cos(relative[2]), math.sin(relative[2])
    xy = (features.pose[:, :2] - relative[:2]) @ np.array([[c, -s], [s, c]]) - np.array(scanner.mount[:2])
    far = np.hypot(xy[:, 0], xy[:, 1])
    bearing = gs.wrap_angle(np.arctan2(xy[:, 1], xy[:, 0]) - scanner.mount[2])
    off = np.abs(gs.wrap_angle(bearing[:, None] - scanner.bearings))
    beam = off.argmin(axis=1)
    near = np.stack([ranges[np.clip(beam + k, 0, scanner.count - 1)] for k in (-2, -1, 0, 1, 2)]).max(axis=0)
    seen: np.ndarray = (off.min(axis=1) < 0.02) & (far < FAR) & (near > far - 0.3)
    return seen


def compared(one: Features, two: Features, relative: np.ndarray, spread: tuple[float, float]) -> list[float | None]:
    """Return the squared distance of each feature to the same feature of another scan, or None."""
    c, s = math.cos(relative[2]), math.sin(relative[2])
    turn = np.array([[c, -s], [s, c]])
    place, heading = two.pose[:, :2] @ turn.T + relative[:2], two.pose[:, 2] + relative[2]
    found: list[float | None] = []
    for i, kind in enumerate(one.kind):
        off = place - one.pose[i, :2]
        distance = np.hypot(off[:, 0], off[:, 1])
        period = 2 * math.pi if kind == "corner" else math.pi
        angle = np.abs(np.mod(heading - one.pose[i, 2] + period / 2, period) - period / 2)
        fits = (two.kind == kind) & (distance < NEAR) & ((angle < TURN) | (kind == "pole"))
        if not fits.any():
            found.append(None)
            continue
        j = int(np.where(fits, distance, np.inf).argmin())
        lever = np.hypot(*two.pose[j, :2])
        both = one.covariance[i, :2, :2] + turn @ two.covariance[j, :2, :2] @ turn.T
        both = both + np.eye(2) * (2 * spread[0] ** 2 + (spread[1] * lever) ** 2)
        found.append(float(off[j] @ np.linalg.solve(both, off[j])))
    return found


def real(arguments: argparse.Namespace) -> tuple[str, dict[str, Any]]:
    """Measure how often features of recordings are found again from another place."""
    rows, report = [], {}
    for name, spread in RECORDINGS.items():
        recording = recordings.load(name)
        scanner = recording.places[0][1]
        events = [event for event in recording.events if np.isfinite(event.truth).all()][:: arguments.every]
        events = events[: arguments.limit]
        features = gs.extract_features(np.array([e.ranges for e in events]), scanner, LANDMARKS, arguments.backend)
        poses = np.array([event.truth for event in events])
        counts = {kind: [0, 0, 0] for kind in LANDMARKS}
        for i in range(len(events)):
            ahead = np.hypot(*(poses[i + 1 :, :2] - poses[i, :2]).T)
            later = np.flatnonzero((ahead >= MOVED[0]) & (ahead <= MOVED[1]))
            if not len(later):
                continue
            j = i + 1 + int(later[0])
            relative = gs.pose_difference(poses[i], poses[j])
            one, two = features.of_scan(i), features.of_scan(j)
            seen = expected_again(one, relative, events[j].ranges, scanner)
            for kind, square, again in zip(one.kind, compared(one, two, relative, spread), seen, strict=True):
                if again:
                    counts[str(kind)][0] += 1
                    counts[str(kind)][1] += square is not None
                    counts[str(kind)][2] += square is not None and square < chi2.ppf(0.9973, 2)
        for kind, (total, again, close) in counts.items():
            report[f"{name} {kind}"] = {"expected": total, "again": again, "within_3_sigma": close}
            share = f"{100 * again / total:.0f}" if total else ""
            sigma = f"{100 * close / again:.0f}" if again else ""
            rows.append([name, len(events), kind, total, share, sigma])
    names = ["recording", "scans", "kind", "should be seen again", "found again [%]", "of these within 3 sigma [%]"]
    return "## Recorded scans\n\n" + table(names, rows), report


def followed(models: list[Any], events: list[Any], readings: list[list[Any]], seed: int) -> dict[str, float]:
    """Return errors and time of a filter over events with readings for each of its models."""
    pf = gs.ParticleFilter(models, particles=1000, seed=seed)
    pf.initialize(mean=events[0].truth, covariance=np.diag([0.25, 0.25, 0.04]))
    errors, seconds = [], 0.0
    for k, event in enumerate(events):
        begin = time.perf_counter()
        if k:
            pf.predict(events[k - 1].odometry, event.odometry)
        given = {model: one[k] for model, one in zip(models, readings, strict=True) if len(one[k])}
        if given:
            pf.correct(given)
        pose = pf.estimate().pose
        seconds += time.perf_counter() - begin
        errors.append(math.hypot(*(pose[:2] - event.truth[:2])))
    late = np.array(errors[len(errors) // 20 :])
    return {
        "median_m": float(np.median(late)), "p95_m": float(np.quantile(late, 0.95)),
        "lost": float(np.mean(late > 1.0)), "ms": 1000 * seconds / len(events),
    }  # fmt: skip


def halves(recording: Any) -> tuple[np.ndarray, np.ndarray, list[Any]]:
    """Return the readings and poses of half of a run's scans, and the events of the other half."""
    if recording.name in recordings.CARMEN:
        log = recordings.data() / "carmen_logs" / f"{recordings.CARMEN[recording.name]}-corrected.log.gz"
        even = recordings.read_steps(log, every=2, offset=0)
        return np.array([s.scan.ranges for s in even]), np.array([s.scan.pose for s in even]), recording.events
    even = recording.events[::2]
    return np.array([e.ranges for e in even]), np.array([e.truth for e in even]), recording.events[1::2]


def localisation(arguments: argparse.Namespace) -> tuple[str, dict[str, Any]]:
    """Compare filters with points and lines with filters with the field, on the same odometry, particles and seeds."""
    rows, report = [], {}
    for name in ("jarvis-s3000", "jarvis-nav350", "intel", "csail"):
        recording = recordings.load(name)
        grid, scanner = recording.places[0]
        before, where, events = halves(recording)
        surveyed = gs.map_features(gs.extract_features(before, scanner, MAPPED, arguments.backend), where)
        events = events[: arguments.limit]
        ranges = np.array([event.ranges for event in events])
        begin = time.perf_counter()
        features = gs.extract_features(ranges, scanner, MAPPED, arguments.backend)
        extraction = 1000 * (time.perf_counter() - begin) / len(events)
        scans = [features.of_scan(k) for k in range(len(events))]
        points = gs.LandmarkModel(surveyed.landmarks(), PARAMETERS, backend=arguments.backend), [
            scan.range_bearing(LANDMARKS) for scan in scans
        ]  # fmt: skip
        lines = gs.LineModel(surveyed.lines(), LINES, backend=arguments.backend), [scan.lines() for scan in scans]
        field = recordings.field(arguments.backend)(grid, scanner), list(ranges)
        settings = {"field": [field], "points": [points], "lines": [lines], "points and lines": [points, lines],
                    "odometry alone": [(points[0], [[]] * len(events))]}  # fmt: skip
        for label, sensors in settings.items():
            models, readings = ([sensor[side] for sensor in sensors] for side in (0, 1))
            runs = [followed(models, events, readings, seed) for seed in range(arguments.seeds)]
            figures = {key: float(np.mean([run[key] for run in runs])) for key in runs[0]}
            is_features = label not in ("field", "odometry alone")
            figures["ms"] += extraction if is_features else 0
            figures["per_scan"] = sum(len(one) for each in readings for one in each) / len(events) if is_features else 0
            report[f"{name} {label}"] = figures | {"points": len(surveyed.landmarks()), "lines": len(surveyed.lines())}
            each = f"{figures['per_scan']:.1f}" if is_features else ""
            rows.append([name, len(events), label, each, f"{figures['median_m']:.3f}", f"{figures['p95_m']:.3f}",
                         f"{100 * figures['lost']:.1f}", f"{figures['ms']:.2f}"])  # fmt: skip
    names = ["recording", "scans", "filter with", "a scan", "error [m], median", "95 %", "beyond 1 m [%]", "ms a scan"]
    return "## Localisation\n\n" + table(names, rows), report


def rates(arguments: argparse.Namespace) -> tuple[str, dict[str, Any]]:
    """Measure scans of 1080 beams a second, in turns."""
    scanner = scanner_of(1080)
    ranges = np.concatenate([scans_of(seed, scanner, 0.01, 50)[0] for seed in range(4)])
    rows, report, limits = [], {}, (arguments.repeats, arguments.seconds)
    for selection in ("numpy", arguments.backend, "warp:cpu"):
        part = ranges[:10] if selection == "numpy" else ranges
        gs.extract_features(part[:1], scanner, backend=selection)
        seconds = best(lambda part=part, b=selection: gs.extract_features(part, scanner, backend=b), *limits)[0]
        one = best(lambda b=selection: gs.extract_features(ranges[0], scanner, backend=b), *limits)[0]
        report[selection] = {"scans_per_s": len(part) / seconds, "one_scan_ms": 1000 * one}
        rows.append([selection, len(part), f"{len(part) / seconds:.0f}", f"{1000 * one:.2f}"])
    names = ["backend", "scans in a call", "scans a second", "a single scan [ms]"]
    return "## Rates\n\n" + table(names, rows), report


def plain(value: Any) -> int | float | None:
    """Return a number for JSON, None for NaN."""
    number = value.item() if hasattr(value, "item") else value
    return None if isinstance(number, float) and math.isnan(number) else number


def draw(arguments: argparse.Namespace) -> None:
    """Draw the scan with the most kinds of features."""
    scanner = scanner_of(720)
    ranges, _ = scans_of(4, scanner, 0.01, 20)
    features = gs.extract_features(ranges, scanner, backend=arguments.backend)
    richest = max(range(len(ranges)), key=lambda k: (len(set(features.of_scan(k).kind)), len(features.of_scan(k))))
    gs.plots.save(gs.plots.features_figure(features.of_scan(richest), ranges[richest], scanner), arguments.figure)


def main(argv: list[str] | None = None) -> None:
    """Run the parts and write the report."""
    parser = make_parser(__doc__, backend="auto", data=True)
    add_repeats(parser, 5, 5.0)
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS, help="default: all")
    parser.add_argument("--floors", type=int, default=20, help="simulated floors (default: %(default)s)")
    parser.add_argument("--scans", type=int, default=20, help="scans of each floor (default: %(default)s)")
    parser.add_argument("--every", type=int, default=1, help="step between recorded scans (default: %(default)s)")
    parser.add_argument("--limit", type=int, default=600, help="most recorded scans (default: %(default)s)")
    parser.add_argument("--seeds", type=int, default=3, help="runs of each filter (default: %(default)s)")
    parser.add_argument(
        "--figure", type=Path, help="draw a scan of a simulated floor with its features, and nothing else"
    )
    arguments = parse(parser, argv)
    if arguments.figure:
        return draw(arguments)
    functions = dict(zip(PARTS, (simulated, real, localisation, rates), strict=True))
    texts, report = [], {}
    for part in PARTS:
        if part in arguments.parts:
            text, figures = functions[part](arguments)
            texts.append(text)
            report[part] = {key: {name: plain(value) for name, value in row.items()} for key, row in figures.items()}
    publish(__file__, arguments, "# Features of scans\n\n" + "\n\n".join(texts), report)


if __name__ == "__main__":
    main()
