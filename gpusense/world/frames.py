"""Convert poses and bearings to a grid's frame in float64, and split them before rounding.

A pose becomes an integer cell, the fraction of that cell, and the cosine and sine of its heading. Precision then
depends neither on the size of the map nor on its coordinates. The kernel ``place_poses`` places poses on a device; this
module places them on the host by the kernel's reference. Both give the same bits.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from gpusense.interface import structs
from gpusense.reference import placement
from gpusense.reference.heading import cos_sin

Mount = tuple[float, float, float]


class Cells(Protocol):
    """Square cells that hold poses: an occupancy grid, or buckets of landmarks."""

    @property
    def origin(self) -> tuple[float, float, float]:
        """Pose (x, y, yaw) of the first cell's corner in the world [m, m, rad]."""

    @property
    def resolution(self) -> float:
        """Side of a cell [m]."""

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of rows and columns."""


class PlainCells(NamedTuple):
    """Cells with plain fields; see Cells."""

    origin: tuple[float, float, float]
    resolution: float
    shape: tuple[int, int]


def plain_cells(cells: Cells) -> PlainCells:
    """Return cells with plain fields, for calls that read them again and again."""
    return PlainCells(cells.origin, cells.resolution, cells.shape)


_IN_TWO_PARTS = frozenset({"TWO_PART_POINTS"})


@dataclass(frozen=True)
class PlacedPoses:
    """Sensor origins in a grid's frame."""

    cell: np.ndarray  # (N, 2) int32 column and row
    pose: np.ndarray  # (N, 4) fraction in x and y, cosine and sine of the heading, rounded
    low: np.ndarray  # (N, 4) rounding error (low part) of ``pose``, itself rounded


def split(values: np.ndarray, real: np.dtype) -> tuple[np.ndarray, np.ndarray]:
    """Split float64 values into rounded values and their rounding errors (low parts).

    In float32 both together hold about 48 bits of a value.
    """
    high = values.astype(real)
    return high, (values - high).astype(real)


@functools.lru_cache(maxsize=256)
def _cos_sin(angle: float) -> tuple[float, float]:
    cos, sin = cos_sin(np.array([angle]))
    return float(cos[0]), float(sin[0])


def frame_of(grid: Cells, mount: Mount) -> structs.Frame:
    """Return the struct ``Frame`` of a grid and a scanner for kernels."""
    x, y, yaw = grid.origin
    return structs.Frame(x, y, grid.resolution, mount[0], mount[1], *_cos_sin(yaw))


def place_poses(poses: np.ndarray, grid: Cells, mount: Mount, real: np.dtype) -> PlacedPoses:
    """Place sensors in a grid: compose each robot pose with the mount, without the mount's yaw.

    ``poses``: (N, 3) float64 robot poses in the world [m, m, rad]; ``grid``: cells that define the frame; ``mount``:
    the sensor's pose on the robot [m, m, rad]; its yaw is part of the bearings.
    """
    count = len(poses)
    placed = PlacedPoses(np.empty((count, 2), np.int32), np.empty((count, 4), real), np.empty((count, 4), real))
    pose_status = np.zeros(2, np.int32)
    with np.errstate(all="ignore"):
        placement.place_poses(
            _IN_TWO_PARTS, np.ascontiguousarray(poses, np.float64), placed.cell, placed.pose, placed.low, pose_status,
            frame_of(grid, mount), structs.Window(0, 0, *grid.shape), count,
        )  # fmt: skip
    return placed


def ray_vectors(bearings: np.ndarray, mount: Mount) -> np.ndarray:
    """Return (K, 2) float64 cosines and sines of the bearings in the robot's frame, the mount's yaw included."""
    turned = bearings + mount[2] if mount[2] != 0.0 else bearings
    vectors = np.empty((*turned.shape, 2))
    vectors[..., 0], vectors[..., 1] = np.cos(turned), np.sin(turned)
    return vectors
