"""Poses relative to a point and headings relative to an angle, in float64 as sums of two numbers, then rounded."""

import warp as wp

from gpusense.interface import constants, formulas

from .float64.error_free import pair_sum, two_sum
from .heading import cos_sin, reduce_heading
from .prelude import doubles, kernel
from .types import real, vec2, vec4

FARTHEST, MINUS_FARTHEST = wp.float64(constants.FARTHEST), wp.float64(-constants.FARTHEST)
f = doubles(formulas)
MINUS_HALF_TURN = wp.float64(-formulas.HALF_TURN)
ZERO, FOUR = wp.float64(0.0), wp.float64(4.0)
MINUS_FOUR = wp.float64(-4.0)


@wp.func
def wrapped_difference(theta: wp.float64, target: wp.vec2d):
    """Return theta - target in [-pi, pi]; the target is in that interval."""
    quadrant, rest = reduce_heading(theta)
    # Up to three quarters are exact: the last bits of QUARTER are 0.
    quarters = wp.float64(quadrant)
    angle = pair_sum(wp.vec2d(quarters * f.QUARTER, quarters * f.QUARTER_LOW), rest)
    angle = pair_sum(angle, -target)
    turns = wp.where(angle.x > f.HALF_TURN, MINUS_FOUR, wp.where(angle.x < MINUS_HALF_TURN, FOUR, ZERO))
    return pair_sum(angle, wp.vec2d(turns * f.QUARTER, turns * f.QUARTER_LOW))


@wp.func
def rounded_place(at: wp.vec2d):
    """Round a coordinate to a sum of two numbers in the model's precision."""
    high = wp.min(wp.max(at.x, MINUS_FARTHEST), FARTHEST)
    low = wp.where(high == at.x, at.y, ZERO)
    rounded = real(high)
    return vec2(rounded, real((high - wp.float64(rounded)) + low))


@kernel
def place_relative(poses, place, pose_status, origin_x, origin_y, mount_x, mount_y, particles):
    """Place sensors relative to an origin: x, its low part, y, its low part."""
    n = wp.tid()
    if n >= particles:
        return
    pose_x = wp.float64(poses[3 * n])
    pose_y = wp.float64(poses[3 * n + 1])
    theta = wp.float64(poses[3 * n + 2])
    if not ((pose_x - pose_x) + (pose_y - pose_y) + (theta - theta) == ZERO):
        wp.atomic_max(pose_status, 0, 1)
        place[n] = vec4()
        return
    x = two_sum(pose_x, -origin_x)
    y = two_sum(pose_y, -origin_y)
    near = wp.abs(x.x) <= FARTHEST and wp.abs(y.x) <= FARTHEST
    if near and (mount_x != ZERO or mount_y != ZERO):
        turned = cos_sin(theta)
        moved_x = two_sum(x.x, turned.x * mount_x - turned.y * mount_y)
        moved_y = two_sum(y.x, turned.y * mount_x + turned.x * mount_y)
        x = two_sum(moved_x.x, moved_x.y + x.y)
        y = two_sum(moved_y.x, moved_y.y + y.y)
    at_x = rounded_place(x)
    at_y = rounded_place(y)
    place[n] = vec4(at_x.x, at_x.y, at_y.x, at_y.y)


@kernel
def wrap_headings(poses, residual, pose_status, target, target_low, particles):
    """Subtract the target from headings and wrap to [-pi, pi], a sum of two numbers."""
    n = wp.tid()
    if n >= particles:
        return
    x = wp.float64(poses[3 * n])
    y = wp.float64(poses[3 * n + 1])
    theta = wp.float64(poses[3 * n + 2])
    if not ((x - x) + (y - y) + (theta - theta) == ZERO):
        wp.atomic_max(pose_status, 0, 1)
        theta = wp.float64(0.0)
    angle = wrapped_difference(theta, wp.vec2d(target, target_low))
    rounded = real(angle.x)
    residual[n] = vec2(rounded, real((angle.x - wp.float64(rounded)) + angle.y))
