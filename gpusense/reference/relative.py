"""Poses relative to a point and headings relative to an angle, in float64 as sums of two numbers, then rounded.

Differences of large coordinates or of many turns are small, and small numbers keep their digits in any precision.
"""

from __future__ import annotations

import numpy as np

from gpusense.interface.constants import FARTHEST
from gpusense.interface.formulas import QUARTER, QUARTER_LOW
from gpusense.reference.error_free import Pair, pair_sum, two_sum, where_pair
from gpusense.reference.heading import cos_sin, reduce_heading


def wrapped_difference(theta: np.ndarray, target: Pair | tuple[float, float]) -> Pair:
    """Return ``theta - target`` in [-pi, pi]; the target is in that interval."""
    quadrant, rest = reduce_heading(theta)
    # Up to three quarters are exact: the last bits of QUARTER are 0.
    quarters = quadrant.astype(np.float64)
    angle = pair_sum((quarters * QUARTER, quarters * QUARTER_LOW), rest)
    angle = pair_sum(angle, (-np.asarray(target[0]), -np.asarray(target[1])))
    turns = np.where(angle[0] > 2 * QUARTER, -4.0, np.where(angle[0] < -2 * QUARTER, 4.0, 0.0))
    return pair_sum(angle, (turns * QUARTER, turns * QUARTER_LOW))


def rounded_place(at: Pair, real: np.dtype) -> Pair:
    """Round coordinates to sums of two numbers in the model's precision."""
    high = np.fmin(np.fmax(at[0], -FARTHEST), FARTHEST)
    low = np.where(high == at[0], at[1], 0.0)
    rounded = high.astype(real)
    return rounded, ((high - rounded.astype(np.float64)) + low).astype(real)


def place_relative(flags, poses, place, pose_status, origin_x, origin_y, mount_x, mount_y, particles):
    """Place sensors relative to an origin: x, its low part, y, its low part.

    ``pose_status``, which the caller clears, becomes 1 at index 0 if a pose is not finite; its place is the origin.
    """
    all_poses = poses.reshape(-1)[: 3 * particles].reshape(-1, 3).astype(np.float64)
    finite: np.ndarray = np.asarray(np.isfinite(all_poses).all(axis=1))
    if not finite.all():
        pose_status[0] = 1
    x_y = two_sum(all_poses[:, :2], -np.array([origin_x, origin_y]))
    if (mount_x, mount_y) != (0.0, 0.0):
        cos, sin = cos_sin(np.ascontiguousarray(all_poses[:, 2]))
        arm = np.stack([cos * mount_x - sin * mount_y, sin * mount_x + cos * mount_y], axis=1)
        moved = two_sum(x_y[0], arm)
        near = (np.abs(x_y[0]) <= FARTHEST).all(axis=1, keepdims=True)
        x_y = where_pair(near, two_sum(moved[0], moved[1] + x_y[1]), x_y)
    x_y = where_pair(finite[:, np.newaxis], x_y, (np.zeros_like(x_y[0]), np.zeros_like(x_y[0])))
    place[:particles, 0::2], place[:particles, 1::2] = rounded_place(x_y, place.dtype)


def wrap_headings(flags, poses, residual, pose_status, target, target_low, particles):
    """Subtract the target from headings and wrap to [-pi, pi], a sum of two numbers; pose_status as for places."""
    all_poses = poses.reshape(-1)[: 3 * particles].reshape(-1, 3).astype(np.float64)
    finite: np.ndarray = np.asarray(np.isfinite(all_poses).all(axis=1))
    if not finite.all():
        pose_status[0] = 1
    high, low = wrapped_difference(np.where(finite, all_poses[:, 2], 0.0), (target, target_low))
    residual[:particles, 0] = high
    residual[:particles, 1] = (high - residual[:particles, 0].astype(np.float64)) + low
