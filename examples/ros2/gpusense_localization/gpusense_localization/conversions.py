"""Conversions between ROS messages and NumPy: messages are read by their fields, and written as plain mappings.

Nothing here imports ROS. ``fill`` copies a mapping into a message.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

Pose = tuple[float, float, float]


def quaternion_of(yaw: float) -> dict[str, float]:
    """Return the fields of geometry_msgs/Quaternion for a rotation about z."""
    return {"x": 0.0, "y": 0.0, "z": math.sin(yaw / 2), "w": math.cos(yaw / 2)}


def yaw_of(quaternion: Any) -> float:
    """Return the rotation about z of a level quaternion."""
    q = quaternion
    return math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z))


def pose_of(message: Any) -> Pose:
    """Return (x, y, yaw) of geometry_msgs/Pose."""
    return message.position.x, message.position.y, yaw_of(message.orientation)


def transform_of(message: Any) -> Pose:
    """Return (x, y, yaw) of geometry_msgs/Transform."""
    return message.translation.x, message.translation.y, yaw_of(message.rotation)


def compose(first: Pose, second: Pose) -> Pose:
    """Return the pose ``second``, given in the frame of ``first``, in the frame of the latter's parent."""
    c, s = math.cos(first[2]), math.sin(first[2])
    x, y = first[0] + c * second[0] - s * second[1], first[1] + s * second[0] + c * second[1]
    return x, y, math.remainder(first[2] + second[2], 2 * math.pi)


def inverse(pose: Pose) -> Pose:
    """Return the pose of the parent's frame in the pose's own."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return -c * pose[0] - s * pose[1], s * pose[0] - c * pose[1], -pose[2]


def map_to_odometry(in_map: Pose, in_odometry: Pose) -> Pose:
    """Return the pose of the odometry frame in the map, from the base's poses in both."""
    return compose(in_map, inverse(in_odometry))


def moved_enough(before: Pose, after: Pose, least: tuple[float, float]) -> bool:
    """Tell whether the robot moved by ``least`` (m along x or y, rad), as nav2_amcl decides to update its filter."""
    turn = abs(math.remainder(after[2] - before[2], 2 * math.pi))
    return abs(after[0] - before[0]) > least[0] or abs(after[1] - before[1]) > least[0] or turn > least[1]


def pose_fields(pose: Pose) -> dict[str, Any]:
    """Return the fields of geometry_msgs/Pose."""
    return {"position": {"x": pose[0], "y": pose[1], "z": 0.0}, "orientation": quaternion_of(pose[2])}


def transform_fields(pose: Pose) -> dict[str, Any]:
    """Return the fields of geometry_msgs/Transform."""
    return {"translation": {"x": pose[0], "y": pose[1], "z": 0.0}, "rotation": quaternion_of(pose[2])}


def covariance_fields(covariance: np.ndarray) -> list[float]:
    """Return the 36 numbers of geometry_msgs/PoseWithCovariance for a (3, 3) covariance of x, y and yaw."""
    full = np.zeros((6, 6))
    full[np.ix_((0, 1, 5), (0, 1, 5))] = covariance
    return [float(value) for value in full.ravel()]


def covariance_of(numbers: Any) -> np.ndarray:
    """Return the (3, 3) covariance of x, y and yaw out of the 36 numbers of geometry_msgs/PoseWithCovariance."""
    full = np.asarray(numbers, np.float64).reshape(6, 6)
    return full[np.ix_((0, 1, 5), (0, 1, 5))]


def cloud_fields(particles: np.ndarray, weights: np.ndarray, most: int = 2000) -> list[dict[str, Any]]:
    """Return the fields of nav2_msgs/Particle of at most ``most`` particles, evenly picked."""
    chosen = np.linspace(0, len(particles) - 1, min(most, len(particles))).astype(int)
    return [
        {"pose": pose_fields((float(x), float(y), float(yaw))), "weight": float(weight)}
        for (x, y, yaw), weight in zip(particles[chosen], weights[chosen], strict=True)
    ]


def host_array(values: Any) -> np.ndarray:
    """Return an array of the device of a filter as a NumPy array."""
    for way in ("get", "numpy"):
        if not isinstance(values, np.ndarray) and hasattr(values, way):
            return np.asarray(getattr(values, way)())
    return np.asarray(values)


def fill(message: Any, fields: Mapping[str, Any]) -> Any:
    """Copy fields into a message, part by part, and return it."""
    for name, value in fields.items():
        if isinstance(value, Mapping):
            fill(getattr(message, name), value)
        else:
            setattr(message, name, value)
    return message
