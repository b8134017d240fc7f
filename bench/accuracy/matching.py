"""Measure scan matching: simulated pairs, recorded pairs with the same guesses as for peers, and scans in maps.

    python bench/accuracy/matching.py --recorded DATA --backend opencl --output bench/results/matching_cpu

Rows "pairs": the sets of ``matching_pairs`` (300 pairs each; truth from reflectors or corrected poses) from the
odometry's guess, without a guess, and from the reference +-0.5 m and +-10 degrees. Rows "single": the same from the
odometry's guess, with a call for each match; the shortest of all calls, and the median pair's shortest one. Rows
"simulated": exact and noisy scans of neighbouring poses in six maps, from guesses with such errors. Rows "map": odd
scans of logs in the maps of their even ones, from such guesses. A match is wrong beyond 0.2 m or 5 degrees. Times are
those of one call with all matches, the best of ``--repeats``, after a first call that compiles; processor times are
summed over cores. NEES is the squared error by the predicted covariance over 3, with a mean of 1 for right covariances;
for pairs it is also given for the third of the matches with the smallest turns of the robot, and for the third with the
largest ones.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

import gpusense as gs
from gpusense.evaluation.matching import WRONG, WRONG_TURN, differences
from gpusense.evaluation.worlds import free_pose
from gpusense.matching.result import ScanMatch

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import make_parser, odd_scans, parse, publish, table

SHIFT, TURN = 0.5, np.radians(10.0)
SCANNER = gs.Scanner.uniform(angle_min=-np.radians(135), angle_increment=np.radians(0.5), count=541, range_max=30.0)
LOGS = ("intel", "freiburg-079", "csail", "aces")
REAL_MAPS = ("depot", "levinelobby", "basement_hallways_5cm")


REPEATS = 3
ROWS = ("pairs", "single", "simulated", "map")


def timed(call: Any) -> tuple[ScanMatch, float, float]:
    """Return the result of a call, and its best wall and processor time of some repeats [s]."""
    match, wall, processor = call(), np.inf, np.inf
    for _ in range(REPEATS):
        begun, used = time.perf_counter(), time.process_time()
        match = call()
        wall, processor = min(wall, time.perf_counter() - begun), min(processor, time.process_time() - used)
    return match, wall, processor


def row(kind: str, name: str, guess: str, backend: str, truth: np.ndarray, call: Any) -> dict[str, Any]:
    """Return the figures of matches with known poses."""
    match, wall, processor = timed(call)
    distance, turn = differences(match.pose, truth)
    wrong = (distance > WRONG) | (turn > WRONG_TURN)
    sure = np.isfinite(match.covariance).all(axis=(1, 2)) & ~wrong
    off = match.pose - truth
    off[:, 2] = gs.wrap_angle(off[:, 2])
    squared = np.einsum("si,sij,sj->s", off[sure], np.linalg.inv(match.covariance[sure]), off[sure]) / 3
    # Wrong matches with a covariance that excludes the truth.
    deviation = np.sqrt(np.einsum("sii->si", match.covariance)[:, :2].max(axis=1))
    lies = wrong & match.usable & (distance > 10 * deviation)
    names, counts = np.unique(match.status, return_counts=True)
    thirds = [squared[some] for some in np.array_split(np.argsort(np.abs(truth[sure, 2])), 3)]
    return {
        "what": kind, "set": name, "guess": guess, "backend": backend, "matches": len(truth),
        "median_mm": 1e3 * np.median(distance), "p95_mm": 1e3 * np.percentile(distance, 95),
        "median_deg": np.degrees(np.median(turn)), "p95_deg": np.degrees(np.percentile(turn, 95)),
        "wrong_percent": 100 * wrong.mean(), "confident_wrong": int(lies.sum()),
        "statuses": dict(zip(names.tolist(), counts.tolist(), strict=True)),
        "nees_mean": squared.mean(), "nees_median": np.median(squared),
        "nees_by_turn": [part.mean() if len(part) else np.nan for part in thirds],
        "ms": 1e3 * wall / len(truth), "processor_ms": 1e3 * processor / len(truth),
    }  # fmt: skip


def one_by_one(
    first: np.ndarray, second: np.ndarray, scanner: gs.Scanner, guess: np.ndarray, backend: str, times: list[float]
) -> ScanMatch:
    """Return the matches of pairs, each from a separate call, and append the time of each call [s]."""
    matches = []
    for before, after, start in zip(first, second, guess, strict=True):
        begun = time.perf_counter()
        matches.append(gs.match_scan(before, after, scanner, start, backend=backend))
        times.append(time.perf_counter() - begun)
    return ScanMatch(**{f.name: np.stack([getattr(match, f.name) for match in matches]) for f in fields(ScanMatch)})


def recorded(data: Path, backend: str, limit: int, chosen: list[str]) -> list[dict[str, Any]]:
    """Return the rows of the recorded pairs."""
    rows: list[dict[str, Any]] = []
    scans: dict[str, tuple[np.ndarray, gs.Scanner]] = {}
    if not {"pairs", "single"} & {*chosen}:
        return rows
    for each in json.loads((data / "matching_pairs" / "pairs.json").read_text())["sets"]:
        name, pairs = each["set"], np.array(each["pairs"])[:limit]
        if name not in scans:
            scans[name] = _scans(data, name)
        ranges, scanner = scans[name]
        first, second = ranges[pairs[:, 0].astype(int)], ranges[pairs[:, 1].astype(int)]
        if "single" in chosen:
            times: list[float] = []
            found = row(
                "single", f"{name} +{each['step']}", "odometry", backend, pairs[:, 2:5],
                lambda a=first, b=second, s=scanner, g=pairs[:, 5:8], t=times: one_by_one(a, b, s, g, backend, t),
            )  # fmt: skip
            least = np.array(times).reshape(-1, len(first)).min(axis=0)
            rows.append(found | {"shortest_ms": 1e3 * least.min(), "middle_ms": 1e3 * np.median(least)})
        if "pairs" not in chosen:
            continue
        for label, guess in {"odometry": pairs[:, 5:8], "none": 0 * pairs[:, 5:8], "perturbed": pairs[:, 8:11]}.items():
            rows.append(
                row("pairs", f"{name} +{each['step']}", label, backend, pairs[:, 2:5],
                    lambda a=first, b=second, s=scanner, g=guess: gs.match_scan(a, b, s, g, backend=backend))
            )  # fmt: skip
    return rows


def _scans(data: Path, name: str) -> tuple[np.ndarray, gs.Scanner]:
    if name == "intel":
        logged = list(gs.read_log(data / "carmen_logs" / "intel-corrected.log.gz", range_max=81.8))
        return np.array([scan.ranges for scan in logged]), logged[0].scanner
    laser = name.rsplit("-", 1)[1]
    with np.load(data / "jarvis_lab" / "jarvis_complex_path_fast.npz") as file:
        ranges = file[f"{laser}_ranges"].astype(np.float64)
        first, step = float(file[f"{laser}_angle_min"]), float(file[f"{laser}_angle_inc"])
    farthest = {"s3000": 50.0, "nav350": 30.0}[laser]
    return ranges, gs.Scanner.uniform(
        angle_min=first, angle_increment=step, count=ranges.shape[1], range_max=farthest, range_min=0.05
    )


def simulated(data: Path | None, backend: str, count: int, seed: int) -> list[dict[str, Any]]:
    """Return the rows of simulated pairs: three generated buildings, and three maps if there are data."""
    maps = {f"building {i}": gs.worlds.building(i) for i in range(3)}
    if data is not None:
        maps |= {name: gs.read_map(data / "ros_maps" / f"{name}.yaml") for name in REAL_MAPS}
    rows = []
    for name, grid in maps.items():
        rng = np.random.default_rng(seed)
        first = np.array([free_pose(grid, rng) for _ in range(count)])
        second = first + rng.uniform(-1, 1, (count, 3)) * (SHIFT, SHIFT, TURN)
        caster = gs.RayCaster(grid, SCANNER.range_max, backend=backend)
        one, two = (caster.cast(poses, SCANNER.bearings).astype(np.float64) for poses in (first, second))
        # Poses in walls see nothing.
        seen = (one.min(axis=1) > 0.1) & (two.min(axis=1) > 0.1)
        one, two, truth = one[seen], two[seen], gs.pose_difference(first, second)[seen]
        guess = truth + rng.uniform(-1, 1, truth.shape) * (SHIFT, SHIFT, TURN)
        for noise in (0.0, 0.02):
            a, b = (scan + rng.normal(0, noise, scan.shape) * (scan < SCANNER.range_max) for scan in (one, two))
            rows.append(
                row("simulated", f"{name}, {noise:g} m noise", "perturbed", backend, truth,
                    lambda a=a, b=b, g=guess: gs.match_scan(a, b, SCANNER, g, backend=backend))
            )  # fmt: skip
    return rows


def in_maps(data: Path, backend: str, limit: int, seed: int) -> list[dict[str, Any]]:
    """Return the rows of odd scans of logs in the maps of their even ones."""
    rows: list[dict[str, Any]] = []
    for name in LOGS:
        grid, numbered = odd_scans(data, name, limit)
        chosen = [scan for _, scan in numbered]
        truth, ranges = np.array([scan.pose for scan in chosen]), np.stack([scan.ranges for scan in chosen])
        guess = truth + np.random.default_rng(seed).uniform(-1, 1, truth.shape) * (SHIFT, SHIFT, TURN)
        for method in ("auto", "gauss_newton"):
            rows.append(
                row(f"map, {method}", name, "perturbed", backend, truth,
                    lambda g=grid, r=ranges, s=chosen[0].scanner, p=guess, m=method: gs.match_scan(
                        g, r, s, p, m, backend))
            )  # fmt: skip
    return rows


def by_turn(found: dict[str, Any]) -> str:
    """Return the NEES of a row's pairs with the least and the largest turn."""
    least, _, largest = found["nees_by_turn"]
    return f"{least:.1f} / {largest:.1f}" if found["what"] in ("pairs", "single") else "-"


def main(argv: list[str] | None = None) -> None:
    """Measure, and publish a table."""
    parser = make_parser(__doc__, backend="auto")
    parser.add_argument("--recorded", type=Path, help="folder of recorded data; without it generated buildings alone")
    parser.add_argument("--matches", type=int, default=300, help="most matches of a row (default: %(default)s)")
    parser.add_argument("--rows", action="append", choices=ROWS, help="default: all")
    parser.add_argument("--repeats", type=int, default=3, help="timed calls of each row (default: %(default)s)")
    arguments: argparse.Namespace = parse(parser, argv)
    global REPEATS
    REPEATS = arguments.repeats
    data, backend, most = arguments.recorded, arguments.backend, arguments.matches
    chosen = arguments.rows or [*ROWS]
    rows = [] if data is None else recorded(data, backend, most, chosen)
    rows += simulated(data, backend, most, arguments.seed) if "simulated" in chosen else []
    rows += [] if data is None or "map" not in chosen else in_maps(data, backend, most, arguments.seed)
    lines = [
        [
            r["what"], r["set"], r["guess"], str(r["matches"]), f"{r['median_mm']:.1f} / {r['p95_mm']:.0f}",
            f"{r['median_deg']:.3f} / {r['p95_deg']:.2f}", f"{r['wrong_percent']:.1f}", str(r["confident_wrong"]),
            f"{r['nees_mean']:.2f} / {r['nees_median']:.2f}", by_turn(r), f"{r['ms']:.2f}", f"{r['processor_ms']:.2f}",
            f"{r['shortest_ms']:.2f} / {r['middle_ms']:.2f}" if "shortest_ms" in r else "-",
        ]
        for r in rows
    ]  # fmt: skip
    columns = [
        "what", "set", "guess", "matches", "median / p95 mm", "median / p95 deg", "wrong %", "confident and wrong",
        "NEES mean / median", "least / largest turn", "ms", "processor ms", "shortest call / median pair, ms",
    ]  # fmt: skip
    publish(__file__, arguments, table(columns, lines), {"rows": rows})


if __name__ == "__main__":
    main()
