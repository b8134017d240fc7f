"""Placement of poses in a window of the grid, in float64: an integer cell, the fraction of it, and the heading.

Only +, -, *, /, floor and comparisons are used, so that every device gives the same bits.
"""

from __future__ import annotations

import numpy as np

from gpusense.reference.heading import cos_sin

# Coordinates are clamped to this many cells: no range reaches as far, and sums of two stay within int32.
FARTHEST = float(1 << 30)
BLOCK = 1 << 12


def within_reach(position: np.ndarray) -> np.ndarray:
    """Clamp coordinates to +-FARTHEST cells; NaN, as after an overflow, becomes -FARTHEST."""
    return np.fmin(np.fmax(position, -FARTHEST), FARTHEST)


def place_pose(
    flags: frozenset[str],
    poses: np.ndarray,
    pose_cell: np.ndarray,
    pose: np.ndarray,
    pose_low: np.ndarray,
    verdict: np.ndarray,
    origin_x: float,
    origin_y: float,
    resolution: float,
    mount_x: float,
    mount_y: float,
    yaw_cos: float,
    yaw_sin: float,
    first_col: int,
    first_row: int,
    rows: int,
    cols: int,
) -> None:
    """Place sensors: (M, 3) poses times the scanner's mount, without its yaw, which belongs to the bearings.

    ``pose_low`` gets the rounding errors (low parts) of ``pose``. ``verdict``, which the caller clears, becomes 1 at
    (0) if a pose is not finite, and at (1) if a sensor is outside the window. A pose that is not finite becomes the
    farthest cell, fraction 0 and heading (1, 0): it sees nothing, and its indices stay in bounds.
    """
    real = pose.dtype.type
    first, size = np.array([[first_col], [first_row]], np.int32), np.array([[cols], [rows]], np.int32)
    x_y_theta = poses.T.astype(np.float64, order="C")
    finite = np.isfinite(x_y_theta).all(axis=0)
    cos, sin = cos_sin(x_y_theta[2])
    position = x_y_theta[:2] - np.array([[origin_x], [origin_y]])
    if (mount_x, mount_y) != (0.0, 0.0):
        position[0] += cos * mount_x - sin * mount_y
        position[1] += sin * mount_x + cos * mount_y
    if yaw_sin != 0.0:
        x, y = position
        position = np.stack([yaw_cos * x + yaw_sin * y, yaw_cos * y - yaw_sin * x])
        cos, sin = cos * yaw_cos + sin * yaw_sin, sin * yaw_cos - cos * yaw_sin
    position = within_reach(position / resolution)
    if not finite.all():
        verdict[0] = 1
        position[:, ~finite] = -FARTHEST
        cos[~finite], sin[~finite] = 1.0, 0.0
    whole = np.floor(position)
    cell = whole.astype(np.int32) - first
    if ((cell < 0) | (cell >= size)).any():
        verdict[1] = 1
    exact = np.stack([*(position - whole), cos, sin])
    rounded = exact.astype(real)
    # A fraction just below 1 may round to 1, which would be the next cell.
    rounded[:2] = np.minimum(rounded[:2], np.nextafter(real(1), real(0)))
    # Column by column: faster than a transpose at once.
    for axis in range(2):
        pose_cell[:, axis] = cell[axis]
    for column in range(4):
        pose[:, column] = rounded[column]
        if "CAREFUL" in flags:
            pose_low[:, column] = exact[column] - rounded[column]


def place_poses(
    flags: frozenset[str],
    poses: np.ndarray,
    pose_cell: np.ndarray,
    pose: np.ndarray,
    pose_low: np.ndarray,
    verdict: np.ndarray,
    origin_x: float,
    origin_y: float,
    resolution: float,
    mount_x: float,
    mount_y: float,
    yaw_cos: float,
    yaw_sin: float,
    first_col: int,
    first_row: int,
    rows: int,
    cols: int,
    particles: int,
) -> None:
    """Place all poses, a block of them at a time."""
    all_poses = poses.reshape(-1)[: 3 * particles].reshape(-1, 3)
    for begin in range(0, particles, BLOCK):
        block = slice(begin, min(begin + BLOCK, particles))
        place_pose(
            flags, all_poses[block], pose_cell[block], pose[block], pose_low[block], verdict, origin_x, origin_y,
            resolution, mount_x, mount_y, yaw_cos, yaw_sin, first_col, first_row, rows, cols,
        )  # fmt: skip
