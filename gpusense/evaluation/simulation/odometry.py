"""Draw the odometry of a run from a motion model."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from gpusense.localization.motion import OdometryMotion, OmniMotion
from gpusense.localization.pose_algebra import compose_poses

Floats = NDArray[np.float64]


def draw_odometry(
    poses: Floats, motion: OdometryMotion | OmniMotion, rng: np.random.Generator, jumps: NDArray[np.bool]
) -> Floats:
    """Return the odometer's poses along true poses; the first one is 0.

    Noise has the model's deviations at the true motion. The odometer has the model's systematic errors, which the model
    corrects.

    Args:
        poses: (T, 3) true poses.
        motion: The noise.
        rng: Random generator.
        jumps: (T,) whether the robot was carried to a pose, without motion of its odometer.
    """
    odometry = np.zeros_like(poses)
    systematic = motion.systematic if isinstance(motion, OdometryMotion) else (0.0, 0.0, 0.0)
    if isinstance(motion, OdometryMotion):
        motion = dataclasses.replace(motion, systematic=(0.0, 0.0, 0.0))
    noise, other = rng.standard_normal((len(poses), 4)), rng.random(len(poses))
    for t in range(1, len(poses)):
        if jumps[t]:
            odometry[t] = odometry[t - 1]
            continue
        step = motion.sampled(poses[t - 1], poses[t])
        first, ahead, left, second = (np.array(step.mean) + np.array(step.deviation) * noise[t]).tolist()
        if other[t] < step.reverse:
            ahead = -ahead
        stretch, gain, drift = systematic
        ahead = ahead / (1 + stretch)
        drifted = drift * ahead / 2
        first, second = (first - drifted) / (1 + gain), (second - drifted) / (1 + gain)
        c, s = math.cos(first), math.sin(first)
        moved = (c * ahead - s * left, s * ahead + c * left, first + second)
        odometry[t] = compose_poses(odometry[t - 1], moved)
    return odometry
