"""Compute motion between scans, with information, by odometry or constant motion."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from gpusense._util.typing import Floats
from gpusense.localization.motion import OdometryMotion, turns_between
from gpusense.localization.motion_fit import fit_odometry_motion
from gpusense.localization.pose_algebra import pose_difference, wrap_angle
from gpusense.world.deskew import part_of_arc

# Least deviations of a motion by odometry [m, rad], for finite information.
_LEAST = (1e-3, 5e-4)
# Most steps in a fit of an odometer's noise.
_MOST_STEPS = 1000
# Deviations of constant motion: a share of the motion, and an amount per scan [m, rad].
_SHARE, _RESTLESS, _RESTLESS_TURN = 0.5, 0.02, 0.02


def odometry_links(motion: OdometryMotion, before: Floats, after: Floats) -> tuple[Floats, Floats]:
    """Return the motions (L, 3) between poses of an odometer without its systematic errors, and their information."""
    count = len(before)
    poses, covariances = np.zeros((count, 3)), np.zeros((count, 3, 3))
    for k in range(count):
        sampled = motion.sampled_turns(*turns_between(before[k], after[k]))
        first, ahead, left, second = sampled.mean
        c, s = math.cos(first), math.sin(first)
        poses[k] = c * ahead - s * left, s * ahead + c * left, first + second
        jacobian = np.array([[-s * ahead, c, -s, 0.0], [c * ahead, s, c, 0.0], [1.0, 0.0, 0.0, 1.0]])
        covariances[k] = jacobian * np.square(sampled.deviation) @ jacobian.T
    covariances += np.diag([_LEAST[0] ** 2, _LEAST[0] ** 2, _LEAST[1] ** 2])
    information: Floats = np.asarray(np.linalg.inv(covariances), np.float64)
    return poses, information


def fitted_motion(odometry: Floats, poses: Floats, joined: NDArray[np.bool]) -> OdometryMotion:
    """Fit the noise of an odometer to matched poses (M, 3); return the default without enough data.

    ``joined`` (M - 1,) marks motions between successive key scans that a match determines in all directions.
    """
    # Use the longest stretch without a gap.
    ends = np.flatnonzero(~np.concatenate([[False], joined, [False]]))
    longest = int(np.argmax(np.diff(ends)))
    part = slice(ends[longest], min(ends[longest + 1], ends[longest] + _MOST_STEPS))
    if part.stop - part.start < 3:
        return OdometryMotion()
    try:
        return fit_odometry_motion(odometry[part], poses[part]).motion
    except ValueError:  # the robot hardly moved
        return OdometryMotion()


def constant_motion_deviation(steps: Floats) -> Floats:
    """Return the deviations (L, 2) of motions (L, 3) copied from the previous step [m, rad]."""
    length = np.hypot(steps[:, 0], steps[:, 1])
    return np.stack([_RESTLESS + _SHARE * length, _RESTLESS_TURN + _SHARE * np.abs(steps[:, 2])], axis=1)


def scan_motions(steps: Floats, times: Floats, duration: float) -> Floats:
    """Return the motions (S, 3) during scans of a duration [s] by the mean velocity before and after each."""
    gaps = np.diff(times)
    velocity = np.where(gaps[:, None] > 0, steps / np.where(gaps > 0, gaps, 1.0)[:, None], 0.0)
    if not len(velocity):
        return np.zeros((len(times), 3))
    both = np.concatenate([velocity[:1], velocity, velocity[-1:]])
    return 0.5 * duration * (both[:-1] + both[1:])


def relative(poses: Floats, first: NDArray[np.int64], second: NDArray[np.int64]) -> Floats:
    """Return (L, 3) poses of second scans in the frames of first ones."""
    found: Floats = pose_difference(poses[first], poses[second])
    return found


def partial_motion(motion: Floats, share: Floats) -> Floats:
    """Return the motions (L, 3) after a share (L,) of full motions along arcs."""
    return np.stack(part_of_arc(motion, share), axis=1)


def filled_motion(motion: Floats, expected: Floats, unseen: Floats) -> Floats:
    """Replace the part of a motion (3,) in a projection's (3, 3) range by the expected motion."""
    off = expected - motion
    off[2] = wrap_angle(off[2])
    result: Floats = motion + unseen @ off
    return result
