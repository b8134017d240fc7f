"""Placement of poses in a window of the grid, in float64: an integer cell, the fraction of it, and the heading."""

import warp as wp

from .flags import FLOAT64, TWO_PART_POINTS
from .heading import cos_sin
from .prelude import kernel, work_item
from .types import Frame, Window, coordinate, real, vec4

# Coordinates are clamped to this many cells: no range reaches so far, and the sum of two fits int32.
FARTHEST, MINUS_FARTHEST = wp.float64(1073741824.0), wp.float64(-1073741824.0)
INFINITE, MINUS_INFINITE = wp.float64(float("inf")), wp.float64(float("-inf"))
ZERO, ONE = wp.float64(0.0), wp.float64(1.0)


@wp.func
def within_reach(position: wp.float64):
    """Clamp a coordinate to +-FARTHEST cells; NaN, as after an overflow, becomes -FARTHEST."""
    above = wp.where(position > MINUS_FARTHEST, position, MINUS_FARTHEST)
    return wp.where(above < FARTHEST, above, FARTHEST)


BELOW_ONE = real(1.0 - (2.0**-53 if FLOAT64 else 2.0**-24))


@wp.func
def place_pose(
    particle: wp.int32, poses: wp.array(dtype=coordinate), pose_cell: wp.array(dtype=wp.vec2i),
    pose: wp.array(dtype=vec4), pose_low: wp.array(dtype=vec4), pose_status: wp.array(dtype=wp.int32),
    frame: Frame, window: Window,
):  # fmt: skip
    """Place a sensor: a pose times the scanner's mount, without its yaw."""
    x = wp.float64(poses[3 * particle])
    y = wp.float64(poses[3 * particle + 1])
    theta = wp.float64(poses[3 * particle + 2])
    finite = (x - x) + (y - y) + (theta - theta) == ZERO
    turned = cos_sin(theta)
    cosine = turned.x
    sine = turned.y
    x = x - frame.origin_x
    y = y - frame.origin_y
    if frame.mount_x != ZERO or frame.mount_y != ZERO:
        x = x + (cosine * frame.mount_x - sine * frame.mount_y)
        y = y + (sine * frame.mount_x + cosine * frame.mount_y)
    if frame.yaw_sin != ZERO:
        x_before = x
        cosine_before = cosine
        x = frame.yaw_cos * x + frame.yaw_sin * y
        y = frame.yaw_cos * y - frame.yaw_sin * x_before
        cosine = cosine * frame.yaw_cos + sine * frame.yaw_sin
        sine = sine * frame.yaw_cos - cosine_before * frame.yaw_sin
    x = within_reach(x / frame.resolution)
    y = within_reach(y / frame.resolution)
    if not finite:
        wp.atomic_max(pose_status, 0, 1)
        x = MINUS_FARTHEST
        y = MINUS_FARTHEST
        cosine = ONE
        sine = ZERO
    whole_x = wp.floor(x)
    whole_y = wp.floor(y)
    cell = wp.vec2i(int(whole_x) - window.col, int(whole_y) - window.row)
    if cell.x < 0 or cell.y < 0 or cell.x >= window.cols or cell.y >= window.rows:
        wp.atomic_max(pose_status, 1, 1)
    pose_cell[particle] = cell
    x = x - whole_x
    y = y - whole_y
    # A fraction just below 1 may round to 1, which would be the next cell.
    rounded = vec4(wp.min(real(x), BELOW_ONE), wp.min(real(y), BELOW_ONE), real(cosine), real(sine))
    pose[particle] = rounded
    if TWO_PART_POINTS:
        pose_low[particle] = vec4(
            real(x - wp.float64(rounded.x)),
            real(y - wp.float64(rounded.y)),
            real(cosine - wp.float64(rounded.z)),
            real(sine - wp.float64(rounded.w)),
        )


# Numbers of a world's frame: x and y of its origin, cosine and sine of its yaw, rows, columns, its first cell, and one
# that is not used.
FRAME_NUMBERS = wp.constant(8)


@wp.func
def frame_in(frames: wp.array(dtype=wp.float64), index: wp.int32, frame: Frame):
    """Return the frame of a world; all worlds share the scanner's position and the resolution."""
    first = index * FRAME_NUMBERS
    moved = Frame()
    moved.origin_x = frames[first]
    moved.origin_y = frames[first + 1]
    moved.resolution = frame.resolution
    moved.mount_x = frame.mount_x
    moved.mount_y = frame.mount_y
    moved.yaw_cos = frames[first + 2]
    moved.yaw_sin = frames[first + 3]
    return moved


@kernel
def place_poses(poses, pose_cell, pose, pose_low, pose_status, frame, window, particles):
    """Place poses: one work-item takes a particle."""
    particle = work_item(wp.tid())
    if particle >= particles:
        return
    place_pose(particle, poses, pose_cell, pose, pose_low, pose_status, frame, window)  # fmt: skip


@kernel
def bound_numbers(number, bounds, count, apart, items):
    """Write the least of some numbers, and the largest of the numbers that lie apart from them; NaN remains."""
    i = wp.tid()
    if i >= items:
        return
    low = INFINITE
    high = MINUS_INFINITE
    for n in range(i, count, items):
        a = wp.float64(number[n])
        b = wp.float64(number[apart + n])
        low = wp.where(a < low or a != a, a, low)
        high = wp.where(b > high or b != b, b, high)
    bounds[i] = low
    bounds[items + i] = high
