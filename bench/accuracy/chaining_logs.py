"""Recorded logs with references for the benchmarks of chains."""

from __future__ import annotations

import csv
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

import gpusense as gs

BOTH = "jarvis-both"


@dataclass
class Log:
    """Scans with odometry and reference poses (NaN where unknown), or a track (t, x, y, theta) of another clock."""

    name: str
    ranges: np.ndarray
    scanner: gs.Scanner
    odometry: np.ndarray
    truth: np.ndarray
    times: np.ndarray | None
    duration: float = 0.0
    track: np.ndarray | None = None
    lasers: tuple[tuple[gs.Scanner, ...], np.ndarray, tuple[float, ...]] | None = None

    @property
    def arguments(self) -> dict[str, Any]:
        """Return the arguments of ``chain_scans`` for the log's scanners."""
        duration = self.duration if self.times is not None else 0.0
        if self.lasers is None:
            return {"scanner": self.scanner, "duration": duration}
        return {"scanner": self.lasers[0], "sensor": self.lasers[1], "duration": self.lasers[2]}


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


def load(data: Path, name: str) -> Log:
    """Return a log by its name."""
    if name == BOTH:
        return both(*(load(data, f"jarvis-{laser}") for laser in ("s3000", "nav350")))
    if name.startswith("jarvis"):
        return jarvis(data / "jarvis_lab", name.removeprefix("jarvis-"))
    if name == "olin":
        return olin(data / "olin_mac_bag")
    if name == "intel":
        return intel(data / "carmen_logs")
    scans, motions = recorded(data, {"fr079": "freiburg-079"}.get(name, name))
    odometry = [np.zeros(3)]
    for motion in motions:
        odometry.append(gs.compose_poses(odometry[-1], motion))
    return from_scans(name, scans, np.array(odometry), np.array([scan.pose for scan in scans]))


def from_scans(name: str, scans: list[gs.Scan], odometry: np.ndarray, truth: np.ndarray) -> Log:
    """Return a log of scans of one scanner; times that decrease are left out."""
    times = np.array([scan.time for scan in scans])
    known = times if (np.diff(times) >= 0).all() else None
    return Log(name, np.stack([scan.ranges for scan in scans]), scans[0].scanner, odometry, truth, known)


def intel(folder: Path) -> Log:
    """Return the log with raw odometry, a few of whose scans have corrected poses."""
    scans = list(gs.read_log(folder / "intel-rawodom-every5.log.gz"))
    truth = np.full((len(scans), 3), np.nan)
    with (folder / "intel-rawodom-matches.csv").open() as file:
        for row in csv.DictReader(file):
            truth[int(row["raw_index"])] = [float(row[name]) for name in ("x_m", "y_m", "theta_rad")]
    return from_scans("intel", scans, np.array([scan.odometry for scan in scans]), truth)


def olin(folder: Path) -> Log:
    """Return the bag, with a reference that was refined in its own map."""
    scans = list(gs.read_log(folder / "macfirst_floor_take_2"))
    rows = np.loadtxt(folder / "derived_reference.csv", delimiter=",", skiprows=1)
    log = from_scans("olin", scans, np.array([scan.odometry for scan in scans]), np.zeros((len(scans), 3)))
    return replace(log, duration=float(np.median([scan.duration for scan in scans])), track=rows[:, :4])


def jarvis(folder: Path, laser: str) -> Log:
    """Return the log of a laser of the bag; the navigation scanner turns once in an eighth of a second."""
    topic = {"s3000": "security", "nav350": "navigation"}[laser]
    bag = folder / "jarvis_complex_path_fast.bag"
    scans = list(gs.read_log(bag, topic=f"/driver_laser_{topic}/laser_scan"))
    track = np.load(folder / "jarvis_complex_path_fast.npz")["gt"]
    log = from_scans(f"jarvis-{laser}", scans, np.array([s.odometry for s in scans]), np.zeros((len(scans), 3)))
    return replace(log, duration=float(np.median([scan.duration for scan in scans])), track=track)


def both(one: Log, two: Log) -> Log:
    """Return the scans of two lasers as one log."""
    times = np.concatenate([one.times, two.times])
    order = np.argsort(times, kind="stable")
    ranges = [*one.ranges, *two.ranges]
    lasers = (one.scanner, two.scanner), (order >= len(one.times)).astype(int), (one.duration, two.duration)
    odometry = np.concatenate([one.odometry, two.odometry])[order]
    return Log(BOTH, [ranges[k] for k in order], one.scanner, odometry, np.zeros((len(order), 3)), times[order],
               track=one.track, lasers=lasers)  # fmt: skip


def references(log: Log, earlier: float) -> np.ndarray:
    """Return the reference poses of the scans; a track is read ``earlier`` seconds before their times."""
    if log.track is None:
        return log.truth
    at, (t, x, y, theta) = log.times - earlier, log.track.T
    columns = [np.interp(at, t, values, np.nan, np.nan) for values in (x, y, np.unwrap(theta))]
    return np.stack(columns, axis=1)
