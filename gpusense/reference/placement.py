"""Poses on their way into a window of the grid, in float64: an integer cell, the fraction of it, and the heading.

Only +, -, *, /, floor and comparisons are used, so that every device places a pose alike to the last bit.
"""

from __future__ import annotations

import numpy as np

from gpusense.reference.heading import cos_sin

# Cells farther off than this are as good as here: no range reaches them, and sums of two stay within int32.
FARTHEST = float(1 << 30)
BLOCK = 1 << 12


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
    """Place sensors: the poses times the scanner's mount, without its yaw, which belongs to the bearings.

    ``pose_low`` takes what rounding to the model's precision took from ``pose``. ``verdict``, which the caller clears,
    becomes 1 where (0) a pose is not finite, (1) a sensor is outside the window. A pose that is not finite becomes the
    farthest cell, fraction 0 and heading (1, 0): it sees nothing, and no index made of it is out of bounds.
    """
    real = pose.dtype.type
    below_one = np.nextafter(real(1), real(0))
    given = poses.reshape(-1, 3)[:particles]
    for begin in range(0, particles, BLOCK):
        end = min(begin + BLOCK, particles)
        x, y, theta = given[begin:end].T.astype(np.float64)
        finite = (x - x) + (y - y) + (theta - theta) == 0.0
        cos, sin = cos_sin(theta)
        x -= origin_x
        y -= origin_y
        if mount_x != 0.0 or mount_y != 0.0:
            x += cos * mount_x - sin * mount_y
            y += sin * mount_x + cos * mount_y
        if yaw_sin != 0.0:
            x, y = yaw_cos * x + yaw_sin * y, yaw_cos * y - yaw_sin * x
            cos, sin = cos * yaw_cos + sin * yaw_sin, sin * yaw_cos - cos * yaw_sin
        # What is not a number, as after an overflow, is far away too.
        x, y = (np.fmin(np.fmax(position / resolution, -FARTHEST), FARTHEST) for position in (x, y))
        if not finite.all():
            verdict[0] = 1
            x[~finite] = y[~finite] = -FARTHEST
            cos[~finite], sin[~finite] = 1.0, 0.0
        for axis, (position, first, count) in enumerate(((x, first_col, cols), (y, first_row, rows))):
            whole = np.floor(position)
            cell = whole.astype(np.int32) - first
            if cell.min() < 0 or cell.max() >= count:
                verdict[1] = 1
            pose_cell[begin:end, axis] = cell
            fraction = position - whole
            # A fraction just below 1 may round to 1, which would be the next cell.
            rounded = np.minimum(fraction.astype(real), below_one)
            pose[begin:end, axis] = rounded
            if "CAREFUL" in flags:
                pose_low[begin:end, axis] = fraction - rounded
        for column, value in ((2, cos), (3, sin)):
            rounded = value.astype(real)
            pose[begin:end, column] = rounded
            if "CAREFUL" in flags:
                pose_low[begin:end, column] = value - rounded
