"""Fields of ROS messages from any object or mapping that has them, without ROS."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpusense._util import checks

_ABSENT = object()
# Largest tilt of a planar pose: 1 minus the cosine of the angle between its z axis and the frame's.
_LEVEL = 1e-3


def field(name: str, message: object, path: str) -> Any:
    """Return a field of a message, such as ``info.origin``.

    Args:
        name: Name of the argument, for errors.
        message: An object with attributes, or a mapping with keys.
        path: The field's name, with dots before names of nested fields.

    Raises:
        TypeError: The message has no such field.
    """
    value = message
    for part in path.split("."):
        value = value.get(part, _ABSENT) if isinstance(value, Mapping) else getattr(value, part, _ABSENT)
        if value is _ABSENT:
            raise TypeError(f"{name}: must have the field {path}, got {checks.show(message)}")
    return value


def real_field(name: str, message: object, path: str) -> float:
    """Return a field that is a finite real number.

    Raises:
        TypeError: The field is absent or not a number.
        ValueError: The number is not finite.
    """
    value = field(name, message, path)
    return checks.real(f"{name}.{path}", value.item() if isinstance(value, np.ndarray) and value.ndim == 0 else value)


def stamp_of(name: str, message: object) -> float:
    """Return the time of a message's header [s]: ``sec`` and ``nanosec``, or ``secs`` and ``nsecs`` of ROS 1."""
    stamp = field(name, message, "header.stamp")
    for seconds, rest in (("sec", "nanosec"), ("secs", "nsecs")):
        try:
            return real_field(name, stamp, seconds) + 1e-9 * real_field(name, stamp, rest)
        except TypeError:
            continue
    raise TypeError(f"{name}: must have a stamp with sec and nanosec, or secs and nsecs, got {checks.show(stamp)}")


def unit_quaternion(name: str, quaternion: object) -> tuple[float, float, float, float]:
    """Return (x, y, z, w) of a quaternion with these fields, divided by its norm.

    Raises:
        TypeError: A field is absent or not a number.
        ValueError: The quaternion is not finite, or 0.
    """
    x, y, z, w = (real_field(name, quaternion, each) for each in "xyzw")
    size = math.hypot(x, y, z, w)
    if not 1e-6 < size < math.inf:
        raise ValueError(f"{name}: must be a rotation, got the quaternion ({x:g}, {y:g}, {z:g}, {w:g})")
    return x / size, y / size, z / size, w / size


def rotation_matrix(x: float, y: float, z: float, w: float) -> np.ndarray:
    """Return the (3, 3) matrix of a quaternion of norm 1."""
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def rotation_of(name: str, quaternion: object) -> np.ndarray:
    """Return the (3, 3) rotation matrix of a quaternion with fields x, y, z and w.

    Raises:
        TypeError: A field is absent or not a number.
        ValueError: The quaternion is not finite, or 0.
    """
    return rotation_matrix(*unit_quaternion(name, quaternion))


def planar_pose(name: str, pose: object) -> tuple[float, float, float]:
    """Return (x, y, yaw) of a pose with fields position and orientation.

    Raises:
        TypeError: A field is absent or not a number.
        ValueError: The pose is not level, or not finite.
    """
    rotation = rotation_of(f"{name}.orientation", field(name, pose, "orientation"))
    if rotation[2, 2] < 1 - _LEVEL:
        rule = "must be level, with a rotation about z only"
        raise ValueError(f"{name}.orientation: {rule}, got a tilt of {math.degrees(math.acos(rotation[2, 2])):.3g} deg")
    x, y = (real_field(name, pose, f"position.{axis}") for axis in "xy")
    return x, y, math.atan2(rotation[1, 0], rotation[0, 0])


def distinct_beams(step: float, count: int) -> int:
    """Return the number of beams, less one if the last beam has the direction of the first."""
    return count - 1 if count > 2 and abs(abs(step) * (count - 1) - 2 * math.pi) < 0.5 * abs(step) else count


def spread_readings(message: object, places: int, upside_down: bool = False) -> NDArray[np.float64]:
    """Return the readings of a ``sensor_msgs/LaserScan`` on evenly spaced bearings of a full turn; NaN in gaps.

    Args:
        message: The scan.
        places: Number of bearings, from -pi on; each reading takes the nearest one.
        upside_down: Whether the beams run clockwise.
    """
    raw = checks.array("message.ranges", field("message", message, "ranges"), ("K",), finite=False)
    first, step = (real_field("message", message, name) for name in ("angle_min", "angle_increment"))
    raw = raw[: distinct_beams(step, len(raw))]
    bearings = (first + step * np.arange(len(raw))) * (-1 if upside_down else 1)
    ranges: NDArray[np.float64] = np.full(places, math.nan)
    ranges[np.rint((bearings + math.pi) / (2 * math.pi) * places).astype(np.int64) % places] = raw
    return ranges


def laser_geometry(message: object) -> dict[str, Any]:
    """Return angle_min, angle_increment, count, range_min and range_max of a ``sensor_msgs/LaserScan``.

    Raises:
        TypeError: A field is absent or not a number.
        ValueError: A value is not finite, or several beams have the same bearing.
    """
    names = ("angle_min", "angle_increment", "range_min", "range_max")
    found: dict[str, Any] = {name: real_field("message", message, name) for name in names}
    found["count"] = len(checks.array("message.ranges", field("message", message, "ranges"), ("K",), finite=False))
    step = found["angle_increment"]
    if found["count"] > 1 and step == 0:
        raise ValueError(f"message.angle_increment: must not be 0 for {found['count']} beams, got {step:g}")
    return found
