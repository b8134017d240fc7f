"""Follow robots by successive matches, scan to scan and scan to map, and compare with the corrected poses.

    python bench/accuracy/matching_odometry.py --recorded DATA --backend opencl --output bench/results/matching_odometry

Rows "scan to scan": each scan of a log is matched to the previous one, from the wheels' raw odometry. Rows "scan to
map": odd scans in the map of the even ones; the guess is the last pose moved by the wheels' odometry, which is kept
where a match fails. Errors are those of relative poses between successive scans; corrected poses themselves have errors
of about a centimetre. "wrong" poses are off by more than 0.2 m or 5 degrees. "confident" matches are wrong by more than
ten of their deviations. A corrected pose is "contradicted" where the matches to both neighbours are wrong and the match
between the neighbours is right. "wheels" are the errors of the odometry itself. "off" is the median distance from the
corrected pose in the map, "lost" the number of scans with more than 0.5 m.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

import gpusense as gs
from gpusense.evaluation.matching import WRONG, WRONG_TURN, differences, relative_poses

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from common import make_parser, note, odd_scans, parse, publish, table

LOGS = ("intel", "freiburg-079", "csail", "aces")


def wrong(poses: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return whether poses are off by more than 0.2 m or 5 degrees."""
    distance, turn = differences(poses, truth)
    return (distance > WRONG) | (turn > WRONG_TURN)


def row(
    kind: str, log: str, found: np.ndarray, truth: np.ndarray, odometry: np.ndarray, failed: int, seconds: float
) -> dict[str, Any]:
    """Return the figures of relative poses."""
    distance, turn = differences(found, truth)
    wheels, wheels_turn = differences(odometry, truth)
    return {
        "what": kind, "log": log, "scans": len(truth) + 1, "median_mm": 1e3 * np.median(distance),
        "p95_mm": 1e3 * np.percentile(distance, 95), "median_deg": np.degrees(np.median(turn)),
        "p95_deg": np.degrees(np.percentile(turn, 95)),
        "wrong_percent": 100 * np.mean(wrong(found, truth)), "failed": failed,
        "wheels_median_mm": 1e3 * np.median(wheels), "wheels_p95_mm": 1e3 * np.percentile(wheels, 95),
        "wheels_median_deg": np.degrees(np.median(wheels_turn)),
        "wheels_p95_deg": np.degrees(np.percentile(wheels_turn, 95)),
        "ms": 1e3 * seconds / len(truth),
    }  # fmt: skip


def confident(match: gs.ScanMatch, truth: np.ndarray) -> int:
    """Return the number of matches with errors of more than ten deviations."""
    distance, turn = differences(match.pose, truth)
    variances = np.einsum("sii->si", match.covariance)
    denied = distance > 10 * np.sqrt(variances[:, :2].max(axis=1))
    denied |= turn > 10 * np.sqrt(variances[:, 2])
    return int((match.usable & wrong(match.pose, truth) & denied).sum())


def recorded(data: Path, log: str) -> tuple[list[gs.Scan], np.ndarray]:
    """Return the scans of a log, and the raw odometry's motion from each scan to the next.

    The odometry of a scan is a copy of its corrected pose. Records of odometry continue the corrected pose of the last
    scan by the wheels, so the last one before a scan holds their motion.
    """
    scans: list[gs.Scan] = []
    motions, wheels = [], None
    for record in gs.read_log(data / f"carmen_logs/{log}-corrected.log.gz", odometry=True):
        if isinstance(record, gs.Odometry):
            wheels = record.pose
            continue
        if scans:
            if wheels is None:
                raise ValueError(f"{log}: must have odometry between scans, got none before scan {len(scans)}")
            motions.append(gs.pose_difference(scans[-1].pose, wheels))
        scans.append(record)
        wheels = None
    return scans, np.array(motions)


def scan_to_scan(data: Path, log: str, backend: str, limit: int) -> dict[str, Any]:
    """Match each scan to the previous one."""
    scans, motions = recorded(data, log)
    scans, guess = scans[:limit], motions[: limit - 1]
    poses = np.array([s.pose for s in scans])
    ranges = np.stack([s.ranges for s in scans])
    gs.match_scan(ranges[:2], ranges[1:3], scans[0].scanner, guess[:2], backend=backend)
    begun = time.perf_counter()
    match = gs.match_scan(ranges[:-1], ranges[1:], scans[0].scanner, guess, backend=backend)
    seconds = time.perf_counter() - begun
    found = np.where(match.usable[:, None], match.pose, guess)
    truth = relative_poses(poses[:-1], poses[1:])
    result = row("scan to scan", log, found, truth, guess, int((~match.usable).sum()), seconds)
    past = gs.match_scan(
        ranges[:-2], ranges[2:], scans[0].scanner,
        np.array([gs.compose_poses(*guess[k : k + 2]) for k in range(len(guess) - 1)]), backend=backend,
    )  # fmt: skip
    off, agree = wrong(match.pose, truth), ~wrong(past.pose, relative_poses(poses[:-2], poses[2:]))
    contradicted = int((off[:-1] & off[1:] & agree).sum())
    return result | {"confident": confident(match, truth), "contradicted": contradicted}


def scan_to_map(data: Path, log: str, backend: str, limit: int) -> dict[str, Any]:
    """Follow the robot in the map, one scan after the other."""
    grid, _ = odd_scans(data, log, limit=1)
    every, motions = recorded(data, log)
    scans = every[1::2][:limit]
    # From an odd scan to the next by way of the even one between them.
    steps = np.array([gs.compose_poses(*motions[k : k + 2]) for k in range(1, 2 * len(scans) - 1, 2)])
    truth = np.array([s.pose for s in scans])
    gs.match_scan(grid, scans[0].ranges, scans[0].scanner, truth[0], backend=backend)
    found, matches, begun = [truth[0]], [], time.perf_counter()
    for scan, step in zip(scans[1:], steps, strict=True):
        guess = gs.compose_poses(found[-1], step)
        match = gs.match_scan(grid, scan.ranges, scan.scanner, guess, backend=backend)
        matches.append(match)
        found.append(match.pose if match.usable else guess)
    seconds = time.perf_counter() - begun
    poses = np.array(found)
    result = row("scan to map", log, relative_poses(poses[:-1], poses[1:]), relative_poses(truth[:-1], truth[1:]),
                 steps, sum(not match.usable for match in matches), seconds)  # fmt: skip
    off = differences(poses, truth)[0]
    several = gs.ScanMatch(**{f.name: np.stack([getattr(m, f.name) for m in matches]) for f in fields(gs.ScanMatch)})
    return result | {
        "confident": confident(several, truth[1:]), "off_mm": 1e3 * float(np.median(off)),
        "lost": int((off > 0.5).sum()),
    }  # fmt: skip


def main(argv: list[str] | None = None) -> None:
    """Measure, and publish a table."""
    parser = make_parser(__doc__, backend="auto")
    parser.add_argument("--recorded", type=Path, required=True, help="folder of recorded data")
    parser.add_argument("--scans", type=int, default=100_000, help="most scans of a log (default: all)")
    parser.add_argument("--log", action="append", choices=LOGS, help="default: all")
    arguments: argparse.Namespace = parse(parser, argv)
    rows = []
    for log in arguments.log or LOGS:
        for follow in (scan_to_scan, scan_to_map):
            rows.append(follow(arguments.recorded, log, arguments.backend, arguments.scans))
            note(f"{rows[-1]['what']}, {log}")
    columns = ["what", "log", "scans", "median / p95 mm", "median / p95 deg", "wrong %", "confident", "failed",
               "contradicted", "wheels: median / p95 mm", "deg", "off mm", "lost", "ms"]  # fmt: skip
    lines = [
        [
            r["what"], r["log"], str(r["scans"]), f"{r['median_mm']:.1f} / {r['p95_mm']:.0f}",
            f"{r['median_deg']:.3f} / {r['p95_deg']:.2f}", f"{r['wrong_percent']:.1f}", str(r["confident"]),
            str(r["failed"]), str(r.get("contradicted", "-")),
            f"{r['wheels_median_mm']:.0f} / {r['wheels_p95_mm']:.0f}",
            f"{r['wheels_median_deg']:.2f} / {r['wheels_p95_deg']:.1f}", f"{r['off_mm']:.0f}" if "off_mm" in r else "-",
            str(r.get("lost", "-")), f"{r['ms']:.1f}",
        ]
        for r in rows
    ]  # fmt: skip
    publish(__file__, arguments, table(columns, lines), {"rows": rows})


if __name__ == "__main__":
    main()
