"""Placement of poses in a window of the grid, in float64: an integer cell, the fraction of it, and the heading.

Only +, -, *, /, floor and comparisons are used, so that every device gives the same bits.
"""

from __future__ import annotations

import numpy as np

from gpusense.interface import structs
from gpusense.reference.heading import cos_sin

# Coordinates are clamped to this many cells: no range reaches so far, and the sum of two fits int32.
FARTHEST = float(1 << 30)
BLOCK = 1 << 12


def within_reach(position: np.ndarray) -> np.ndarray:
    """Clamp coordinates to +-FARTHEST cells; NaN, as after an overflow, becomes -FARTHEST."""
    return np.fmin(np.fmax(position, -FARTHEST), FARTHEST)


def place_pose(flags, poses, pose_cell, pose, pose_low, pose_status, frame, window):
    """Place sensors: (M, 3) poses times the scanner's mount, without its yaw, which belongs to the bearings.

    ``pose_low`` gets the rounding errors (low parts) of ``pose``. ``pose_status``, which the caller clears, becomes 1
    at index 0 if a pose is not finite, and at index 1 if a sensor is outside the window. A non-finite pose becomes the
    farthest cell, fraction 0 and heading (1, 0): it sees nothing, and its indices stay in bounds.
    """
    real = pose.dtype.type
    first, size = np.array([[window.col], [window.row]], np.int32), np.array([[window.cols], [window.rows]], np.int32)
    x_y_theta = poses.T.astype(np.float64, order="C")
    finite = np.isfinite(x_y_theta).all(axis=0)
    cos, sin = cos_sin(x_y_theta[2])
    position = x_y_theta[:2] - np.array([[frame.origin_x], [frame.origin_y]])
    if (frame.mount_x, frame.mount_y) != (0.0, 0.0):
        position[0] += cos * frame.mount_x - sin * frame.mount_y
        position[1] += sin * frame.mount_x + cos * frame.mount_y
    if frame.yaw_sin != 0.0:
        x, y = position
        position = np.stack([frame.yaw_cos * x + frame.yaw_sin * y, frame.yaw_cos * y - frame.yaw_sin * x])
        cos, sin = cos * frame.yaw_cos + sin * frame.yaw_sin, sin * frame.yaw_cos - cos * frame.yaw_sin
    position = within_reach(position / frame.resolution)
    if not finite.all():
        pose_status[0] = 1
        position[:, ~finite] = -FARTHEST
        cos[~finite], sin[~finite] = 1.0, 0.0
    whole = np.floor(position)
    cell = whole.astype(np.int32) - first
    if ((cell < 0) | (cell >= size)).any():
        pose_status[1] = 1
    exact = np.stack([*(position - whole), cos, sin])
    rounded = exact.astype(real)
    # A fraction just below 1 may round to 1, which would be the next cell.
    rounded[:2] = np.minimum(rounded[:2], np.nextafter(real(1), real(0)))
    # Column by column is faster than a transposed copy.
    for axis in range(2):
        pose_cell[:, axis] = cell[axis]
    for column in range(4):
        pose[:, column] = rounded[column]
        if "TWO_PART_POINTS" in flags:
            pose_low[:, column] = exact[column] - rounded[column]


# Numbers of a world's frame: x and y of its origin, cosine and sine of its yaw, rows, columns, its first cell, and one
# that is not used.
FRAME_NUMBERS = 8


def frame_in(frames: np.ndarray, index: int, frame: structs.Frame) -> structs.Frame:
    """Return the frame of a world; all worlds share the scanner's position and the resolution."""
    x, y, cosine, sine = frames[index * FRAME_NUMBERS : index * FRAME_NUMBERS + 4].tolist()
    return frame._replace(origin_x=x, origin_y=y, yaw_cos=cosine, yaw_sin=sine)


def place_poses(flags, poses, pose_cell, pose, pose_low, pose_status, frame, window, particles):
    """Place all poses, a block of them at a time."""
    all_poses = poses.reshape(-1)[: 3 * particles].reshape(-1, 3)
    for begin in range(0, particles, BLOCK):
        block = slice(begin, min(begin + BLOCK, particles))
        place_pose(flags, all_poses[block], pose_cell[block], pose[block], pose_low[block], pose_status, frame, window)


def bound_numbers(flags, number, bounds, count, apart, items):
    """Write the least of some numbers, and the largest of the numbers that lie apart from them; NaN remains.

    Work-item ``i`` takes every ``items``-th number from ``i`` on; ``items`` is a multiple of three, so that each sees
    one column of poses. A first launch bounds the poses, and a second one the results of the first, in two halves.
    """
    rows = -(-count // items)
    for half, first, reduce, beyond in ((0, 0, np.minimum.reduce, np.inf), (1, apart, np.maximum.reduce, -np.inf)):
        padded = np.full(rows * items, beyond)
        padded[:count] = number[first : first + count]
        bounds[half * items : (half + 1) * items] = reduce(padded.reshape(rows, items), axis=0)
