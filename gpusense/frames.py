"""Poses and bearings on their way to a device: into the grid's frame in float64, split, and only then rounded.

A pose becomes an integer cell, the fraction of that cell, and the cosine and sine of its heading. Precision then does
not depend on how large the map or its coordinates are, and no kernel evaluates a trigonometric function.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gpusense.grid import OccupancyGrid

Mount = tuple[float, float, float]

# Cells farther off than this are as good as here: no range reaches them, and sums of two stay within int32.
_FARTHEST = float(1 << 30)


@dataclass(frozen=True)
class PlacedPoses:
    """Sensor origins in a grid's frame.

    Attributes:
        cell: (N, 2) int32 column and row.
        pose: (N, 4) fraction in x and y, cosine and sine of the heading, rounded.
        low: (N, 4) what rounding took from ``pose``, itself rounded.
    """

    cell: np.ndarray
    pose: np.ndarray
    low: np.ndarray


def split(values: np.ndarray, real: np.dtype) -> tuple[np.ndarray, np.ndarray]:
    """Rounded values and what rounding took from them; they sum to the float64 values to about 48 bits."""
    high = values.astype(real)
    return high, (values - high).astype(real)


def to_grid(grid: OccupancyGrid, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """World coordinates relative to the grid's origin in cell units of the grid's frame, float64."""
    yaw = grid.origin[2]
    if yaw != 0.0:
        cos, sin = np.cos(yaw), np.sin(yaw)
        x, y = cos * x + sin * y, cos * y - sin * x
    return x / grid.resolution, y / grid.resolution


def place_poses(poses: np.ndarray, grid: OccupancyGrid, mount: Mount, real: np.dtype) -> PlacedPoses:
    """Place sensors in a grid: the pose times the scanner's mount, without the mount's yaw.

    Args:
        poses: (N, 3) float64 robot poses in the world, metres and radians.
        grid: The map that gives the frame.
        mount: The sensor's pose on the robot; its yaw belongs to the bearings.
        real: Precision of the result.
    """
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    x, y = poses[:, 0] - grid.origin[0], poses[:, 1] - grid.origin[1]
    if mount[0] != 0.0 or mount[1] != 0.0:
        x = x + (cos * mount[0] - sin * mount[1])
        y = y + (sin * mount[0] + cos * mount[1])
    x, y = to_grid(grid, x, y)
    yaw = grid.origin[2]
    if yaw != 0.0:
        turn_cos, turn_sin = np.cos(yaw), np.sin(yaw)
        cos, sin = cos * turn_cos + sin * turn_sin, sin * turn_cos - cos * turn_sin
    exact = np.stack([x, y, cos, sin], axis=1)
    position = np.clip(exact[:, :2], -_FARTHEST, _FARTHEST)
    whole = np.floor(position)
    exact[:, :2] = position - whole
    pose = exact.astype(real)
    # A fraction just below 1 may round to 1, which would be the next cell.
    pose[:, :2] = np.minimum(pose[:, :2], np.nextafter(real.type(1), real.type(0)))
    return PlacedPoses(whole.astype(np.int32), pose, (exact - pose).astype(real))


def ray_vectors(bearings: np.ndarray, mount: Mount) -> np.ndarray:
    """(K, 2) float64 cosines and sines of bearings in the robot's frame, the mount's yaw included."""
    turned = bearings + mount[2] if mount[2] != 0.0 else bearings
    return np.stack([np.cos(turned), np.sin(turned)], axis=-1)
