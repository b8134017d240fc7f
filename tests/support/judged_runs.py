"""A run in a room, as a bag with the poses of a localiser, and its true poses."""

from __future__ import annotations

import functools
import math
from pathlib import Path

import numpy as np
from support.bags import Writer

import gpusense as gs

SCANS, STEP, BEAMS = 60, 0.2, 90
FIRST, TURN = -math.pi, 2 * math.pi / BEAMS
SCANNER = gs.Scanner(FIRST + TURN * np.arange(BEAMS), 8.0, 0.1)
# Scans whose pose is wrong in ``carried``.
CARRIED = slice(30, 45)
EARLIEST = 1000.0
TIMES = EARLIEST + STEP * np.arange(SCANS)


@functools.cache
def room() -> gs.OccupancyGrid:
    """Return the map of an L-shaped room with a box, in which no two places look alike."""
    cells = np.pad(np.zeros((80, 120), int), 2, constant_values=100)
    cells[40:, :50] = 100
    cells[10:16, 70:90] = 100
    return gs.OccupancyGrid(cells, resolution=0.1)


@functools.cache
def truth() -> np.ndarray:
    """Return (S, 3) true poses."""
    poses = [np.array([2.0, 2.5, 0.0])]
    for k in range(SCANS - 1):
        poses.append(gs.compose_poses(poses[-1], (0.1, 0.0, 0.03 if k % 20 < 10 else -0.03)))
    return np.array(poses)


@functools.cache
def ranges() -> np.ndarray:
    """Return (S, K) readings with noise of 1 cm."""
    caster = gs.RayCaster(room(), range_max=20.0, backend="numpy")
    clean = caster.cast(truth(), SCANNER.bearings)
    noisy = clean + np.random.default_rng(0).normal(0, 0.01, clean.shape)
    return np.where(noisy < SCANNER.range_max, noisy, np.inf)


def carried() -> np.ndarray:
    """Return the true poses, but 1.5 m off in the scans ``CARRIED``."""
    poses = truth().copy()
    poses[CARRIED] = gs.compose_poses(poses[CARRIED], (0.3, 1.5, 1.0))
    return poses


def scans() -> list[gs.Scan]:
    """Return the scans as records."""
    return [gs.Scan(t, z, SCANNER, tuple(p), None) for t, z, p in zip(TIMES, ranges(), truth(), strict=True)]


def write_bag(
    folder: Path,
    poses: np.ndarray,
    source: str,
    *,
    kind: str = "mcap",
    frame: str = "map",
    readings: np.ndarray | None = None,
) -> Path:
    """Write ``map.yaml`` and a bag.

    Args:
        folder: Place of the files.
        poses: (S, 3) poses of the localiser.
        source: "covariance", "stamped" or "odometry" for the type of messages on /amcl_pose; "tf"; or "none".
        kind: Kind of the bag.
        frame: Frame of the poses.
        readings: (S, K) readings; None for the true poses.
    """
    gs.write_map(room(), folder / "map.yaml")
    scans_at = ranges() if readings is None else readings
    with Writer(folder, kind) as bag:
        bag.transform(EARLIEST, "base_link", "laser", (0.0, 0.0), 0.0)
        for time, z, true, (x, y, theta) in zip(TIMES, scans_at, truth(), poses.tolist(), strict=True):
            # Odometry begins at 0 and is exact.
            moved = gs.pose_difference(truth()[0], true)
            bag.transform(time, "odom", "base_link", moved[:2], moved[2], topic="/tf")
            if source == "tf":
                base = gs.compose_poses((x, y, theta), gs.invert_poses(moved))
                bag.transform(time, frame, "odom", base[:2], base[2], topic="/tf")
            elif source == "odometry":
                bag.odometry(time, x, y, theta, topic="/amcl_pose", frame=frame)
            elif source != "none":
                spread = (1e-4, 1e-4, 1e-5) if source == "covariance" else None
                bag.pose(time, x, y, theta, frame=frame, covariance=spread)
            bag.scan(time, z, FIRST, TURN)
    return bag.path
