"""Messages of ROS for tests without ROS, and a map for them."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np

import gpusense as gs
from gpusense.ros import conversions


def scan_of(count: int, seconds: int = 0) -> Any:
    header = SimpleNamespace(stamp=SimpleNamespace(sec=seconds, nanosec=0))
    return SimpleNamespace(header=header, angle_min=-math.pi, angle_increment=2 * math.pi / count, range_min=0.1,
                           range_max=8.0, ranges=np.full(count, 2.0))  # fmt: skip


def grid(wall: int = 0) -> gs.OccupancyGrid:
    """Return a room, with a wall of some cells in it."""
    cells = np.zeros((40, 40), np.int8)
    cells[[0, -1]] = cells[:, [0, -1]] = cells[:wall, 20] = 100
    return gs.OccupancyGrid(cells, 0.1)


def stamped(time: float, frame: str = "map", **fields: Any) -> Any:
    stamp = SimpleNamespace(sec=int(time), nanosec=round((time - int(time)) * 1e9))
    return SimpleNamespace(**fields | {"header": SimpleNamespace(stamp=stamp, frame_id=frame)})


def pose_message(time: float, pose: Any, deviation: float = 0.05) -> Any:
    place = SimpleNamespace(position=SimpleNamespace(), orientation=SimpleNamespace())
    conversions.fill(place, conversions.pose_fields(tuple(map(float, pose))))
    covariance = conversions.covariance_fields(np.diag([deviation**2, deviation**2, 0.0025]))
    return stamped(time, pose=SimpleNamespace(pose=place, covariance=covariance))
