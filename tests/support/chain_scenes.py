"""Laps, scans and odometers for tests of chains of scans."""

from __future__ import annotations

import numpy as np
from support.matching_scenes import box, segments_scan

import gpusense as gs
from gpusense.world.pose_algebra import rotations

# A ring of corridors with niches around a block: each place is observed in all directions.
BLOCK = np.array([
    *box(0, 0, 24, 18), *box(2.5, 2.5, 21.5, 15.5), *box(7, 0, 7.6, 0.5), *box(16, 2.0, 17, 2.5), *box(23.2, 6, 24, 7),
    *box(21.5, 11, 22, 12.5), *box(13, 17.4, 14, 18), *box(5, 15.5, 6.5, 16.1), *box(0, 10, 0.6, 10.8),
    *box(2.5, 5, 3, 6),
])  # fmt: skip
OTHER = np.array([*box(-3, -3, 18, 9), *box(0.2, 0.4, 15, 6.1), *box(4, -3, 4.9, -2.3), *box(15.0, 1, 16.1, 2.2)])


def around(step: float, laps: float = 1.1) -> np.ndarray:
    """Return poses along the corridors of BLOCK, with rounded turns."""
    x1, y1, x2, y2, r = 1.25, 1.25, 22.75, 16.75, 0.6
    poses = []
    sides = [(x1 + r, y1, 0.0, x2 - x1 - 2 * r), (x2, y1 + r, np.pi / 2, y2 - y1 - 2 * r),
             (x2 - r, y2, np.pi, x2 - x1 - 2 * r), (x1, y2 - r, -np.pi / 2, y2 - y1 - 2 * r)]  # fmt: skip
    for x, y, heading, length in sides:
        for s in np.arange(0, length, step):
            poses.append((x + s * np.cos(heading), y + s * np.sin(heading), heading))
        x, y = x + length * np.cos(heading), y + length * np.sin(heading)
        for t in np.arange(0, np.pi / 2, step / r):
            ahead, left = r * np.sin(t), r * (1 - np.cos(t))
            c, s = np.cos(heading), np.sin(heading)
            poses.append((x + c * ahead - s * left, y + s * ahead + c * left, heading + t))
    whole = np.array(poses)
    return whole[np.arange(int(laps * len(whole))) % len(whole)]


def scans_of(
    walls: np.ndarray, poses: np.ndarray, scanner: gs.Scanner, noise: float = 0.01, seed: int = 0
) -> np.ndarray:
    """Return noisy readings at poses."""
    rng = np.random.default_rng(seed)
    ranges = np.array([segments_scan(walls, tuple(pose), scanner) for pose in poses])
    return ranges + rng.normal(0, noise, ranges.shape)


def drifting(poses: np.ndarray, stretch: float = 1.03, turn: float = 0.01) -> np.ndarray:
    """Return poses of an odometer that overestimates distances and adds turns [rad/m]."""
    steps = gs.pose_difference(poses[:-1], poses[1:])
    steps[:, 2] += turn * np.hypot(steps[:, 0], steps[:, 1])
    steps[:, :2] *= stretch
    result = [np.array([3.0, -2.0, 1.0])]
    for step in steps:
        result.append(gs.compose_poses(result[-1], step))
    return np.array(result)


def errors(chain: gs.ScanChain, truth: np.ndarray) -> np.ndarray:
    """Return distances between estimated and true poses in the frame of the first scan [m]."""
    off = gs.pose_difference(chain.poses[0], chain.poses) - gs.pose_difference(truth[0], truth)
    return np.hypot(*off[:, :2].T)


def normalised_errors(chain: gs.ScanChain, truth: np.ndarray) -> np.ndarray:
    """Return squared errors of poses (S - 1,) over their covariances, 1 in the mean of right covariances."""
    off = gs.pose_difference(chain.poses[0], chain.poses) - gs.pose_difference(truth[0], truth)
    off = off[1:] @ rotations(chain.poses[0, 2]).T
    return np.einsum("si,sij,sj->s", off, np.linalg.inv(chain.covariance[1:]), off) / 3


def wrong_motions(chain: gs.ScanChain, truth: np.ndarray) -> np.ndarray:
    """Return whether motions from scan to scan (S - 1,) are off by more than 0.3 m or 0.15 rad."""
    off = gs.pose_difference(chain.poses[:-1], chain.poses[1:]) - gs.pose_difference(truth[:-1], truth[1:])
    return (np.hypot(off[:, 0], off[:, 1]) > 0.3) | (np.abs(gs.wrap_angle(off[:, 2])) > 0.15)
