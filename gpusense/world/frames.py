"""Poses and bearings on their way to a device: into the grid's frame in float64, split, and only then rounded.

A pose becomes an integer cell, the fraction of that cell, and the cosine and sine of its heading. Precision then does
not depend on how large the map or its coordinates are. Poses are placed by the kernel ``place_poses`` or here, by its
reference; both give the same bits.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from gpusense.reference import placement
from gpusense.reference.heading import cos_sin
from gpusense.world.grid import OccupancyGrid

Mount = tuple[float, float, float]
Frame = tuple[float, float, float, float, float, float, float]


class Cells(Protocol):
    """What poses are placed in: an occupancy grid, or buckets of landmarks."""

    @property
    def origin(self) -> tuple[float, float, float]:
        """(x, y, yaw) of the first cell's corner in the world."""

    @property
    def resolution(self) -> float:
        """Side of a cell [m]."""

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""


_CAREFUL = frozenset({"CAREFUL"})


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


@functools.lru_cache(maxsize=256)
def _cos_sin(angle: float) -> tuple[float, float]:
    cos, sin = cos_sin(np.array([angle]))
    return float(cos[0]), float(sin[0])


def frame_scalars(grid: Cells, mount: Mount) -> Frame:
    """The grid's frame and the mount as the kernel ``place_poses`` takes them, from ``origin_x`` to ``yaw_sin``."""
    x, y, yaw = grid.origin
    return x, y, grid.resolution, mount[0], mount[1], *_cos_sin(yaw)


def place_poses(poses: np.ndarray, grid: Cells, mount: Mount, real: np.dtype) -> PlacedPoses:
    """Place sensors in a grid: the pose times the scanner's mount, without the mount's yaw.

    Args:
        poses: (N, 3) float64 robot poses in the world, metres and radians.
        grid: The cells that give the frame.
        mount: The sensor's pose on the robot; its yaw belongs to the bearings.
        real: Precision of the result.
    """
    count = len(poses)
    placed = PlacedPoses(np.empty((count, 2), np.int32), np.empty((count, 4), real), np.empty((count, 4), real))
    verdict = np.zeros(2, np.int32)
    with np.errstate(all="ignore"):
        placement.place_poses(
            _CAREFUL, np.ascontiguousarray(poses, np.float64), placed.cell, placed.pose, placed.low, verdict,
            *frame_scalars(grid, mount), 0, 0, *grid.shape, count,
        )  # fmt: skip
    return placed


def ray_vectors(bearings: np.ndarray, mount: Mount) -> np.ndarray:
    """(K, 2) float64 cosines and sines of bearings in the robot's frame, the mount's yaw included."""
    turned = bearings + mount[2] if mount[2] != 0.0 else bearings
    return np.stack([np.cos(turned), np.sin(turned)], axis=-1)
