"""A simulated robot among landmarks: poses, features at each pose, and a folder in MRCLAM's format."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

SIGMA_RANGE, SIGMA_BEARING, Z_FALSE, P_DETECT, RANGE_MAX = 0.12, 0.04, 0.08, 0.65, 9.0


@dataclass(frozen=True)
class Seen:
    """Features of all scans, each with landmark and scan, and a mask of false positives."""

    xy: np.ndarray
    poses: np.ndarray
    features: np.ndarray
    ids: np.ndarray
    scan: np.ndarray
    false: np.ndarray


def wrap(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi


def simulate(seed, *, scans=120, landmarks=12, field_of_view=2 * math.pi, bias=(0.0, 0.0), noise=1.0):
    """Draw features by the definition of the landmark model: in view, detected, within the limits, some replaced."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-5, 5, (landmarks, 2))
    poses = np.column_stack([rng.uniform(-4, 4, (scans, 2)), rng.uniform(-9, 9, scans)])
    found = []
    for s, (x, y, theta) in enumerate(poses):
        away = xy - [x, y]
        d, b = np.hypot(*away.T), wrap(np.arctan2(away[:, 1], away[:, 0]) - theta)
        for j in np.flatnonzero((d <= RANGE_MAX) & (np.abs(b) <= field_of_view / 2)):
            while rng.random() < P_DETECT:
                r = d[j] + bias[0] + noise * rng.normal(0, SIGMA_RANGE)
                angle = wrap(b[j] + bias[1] + noise * rng.normal(0, SIGMA_BEARING))
                # Redraw features beyond the limits, detected or not.
                if 0 <= r <= RANGE_MAX and abs(angle) <= field_of_view / 2:
                    found.append((r, angle, j, s))
                    break
    table = np.array(found)
    false = rng.random(len(table)) < Z_FALSE * (noise > 0)
    table[false, 0] = rng.uniform(0, RANGE_MAX, false.sum())
    table[false, 1] = rng.uniform(-field_of_view / 2, field_of_view / 2, false.sum())
    return Seen(xy, poses, table[:, :2], table[:, 2].astype(int), table[:, 3].astype(int), false)


def write_run(
    folder: Path, *, seed: int = 0, swap: tuple[int, int] | None = None, seconds: float = 60.0, wander: float = 0.0,
    wrong: bool = False,
) -> Path:  # fmt: skip
    """Write a run of robot 1 in MRCLAM's files: subjects 6 to 15, barcodes 100 more; subjects of ``swap`` exchanged.

    The odometer's heading has a random walk of ``wander`` rad / sqrt(s); ``wrong`` writes the map of another room.
    """
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-4, 4, (10, 2))
    time = np.arange(0, seconds, 0.1)
    speed, turn = np.full(len(time), 0.4), 0.25 + 0.2 * np.sin(time / 7)
    pose = np.zeros((len(time), 3))
    pose[0] = (0.0, -1.5, 0.2)
    for i in range(1, len(time)):
        x, y, theta = pose[i - 1]
        pose[i] = (x + 0.04 * math.cos(theta), y + 0.04 * math.sin(theta), theta + 0.1 * turn[i - 1])
    lines = []
    for i in range(5, len(time), 3):
        away = xy - pose[i, :2]
        d, b = np.hypot(*away.T), wrap(np.arctan2(away[:, 1], away[:, 0]) - pose[i, 2])
        for j in np.flatnonzero((d < 6) & (np.abs(b) < 0.9) & (rng.random(len(xy)) < 0.7)):
            r, angle = d[j] + rng.normal(0, 0.08), b[j] + rng.normal(0, 0.03)
            lines.append(f"{time[i]:.2f} {106 + j} {max(r, 0):.4f} {angle:.4f}")
    lines.append(f"{time[-1]:.2f} 5 1.0 0.0")
    places = np.arange(10)
    if swap is not None:
        a, b = swap[0] - 6, swap[1] - 6
        places[[a, b]] = places[[b, a]]
    noisy = np.column_stack([speed * (1 + rng.normal(0, 0.05, len(time))), turn + rng.normal(0, 0.03, len(time))])
    noisy[:, 1] += np.random.default_rng(seed + 1).normal(0, wander / math.sqrt(0.1), len(time))
    if wrong:
        xy = np.random.default_rng(seed + 5).uniform(-4, 4, (10, 2))
    texts = {
        "Landmark_Groundtruth.dat": [f"{6 + j} {xy[k, 0]:.6f} {xy[k, 1]:.6f} 0.001 0.001" for j, k in
                                     enumerate(places)],
        "Barcodes.dat": ["1 5", *(f"{6 + j} {106 + j}" for j in range(10))],
        "Robot1_Odometry.dat": [f"{t:.2f} {v:.5f} {w:.5f}" for t, (v, w) in zip(time, noisy, strict=True)],
        "Robot1_Measurement.dat": lines,
        "Robot1_Groundtruth.dat": [f"{t:.2f} {x:.5f} {y:.5f} {wrap(theta):.5f}" for t, (x, y, theta) in
                                   zip(time, pose, strict=True)],
    }  # fmt: skip
    folder.mkdir(parents=True, exist_ok=True)
    for name, rows in texts.items():
        (folder / name).write_text("# made up\n" + "\n".join(rows) + "\n")
    return folder
