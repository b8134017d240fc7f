"""Read fields of ROS messages from any object or mapping, without ROS."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpusense._util import checks

_ABSENT = object()
LEVEL = math.acos(1 - 1e-3)
"""Largest tilt of a level pose [rad]."""
# Largest negative eigenvalue of a covariance that rounding may cause, relative to its largest variance.
_ROUNDING = 1e-6


def field(name: str, message: object, path: str) -> Any:
    """Return a field of a message, such as ``info.origin``.

    ``name``: name of the argument, for errors; ``message``: an object with attributes, or a mapping with keys;
    ``path``: name of the field; dots separate nested names.
    """
    value = message
    for part in path.split("."):
        value = value.get(part, _ABSENT) if isinstance(value, Mapping) else getattr(value, part, _ABSENT)
        if value is _ABSENT:
            raise TypeError(f"{name}: must have the field {path}, got {checks.show(message)}")
    return value


def real_field(name: str, message: object, path: str) -> float:
    """Return a field that is a finite real number."""
    return checks.real(f"{name}.{path}", _number(message, path, name))


def _number(message: object, path: str, name: str = "message") -> Any:
    value = field(name, message, path)
    return value.item() if isinstance(value, np.ndarray) and value.ndim == 0 else value


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
    """Return (x, y, z, w) of a quaternion with these fields, divided by its norm."""
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


def planar_part(name: str, pose: object) -> tuple[tuple[float, float, float], float]:
    """Return (x, y, yaw) of a pose with fields position and orientation, and its tilt [rad]."""
    rotation = rotation_matrix(*unit_quaternion(f"{name}.orientation", field(name, pose, "orientation")))
    x, y = (real_field(name, pose, f"position.{axis}") for axis in "xy")
    return (x, y, math.atan2(rotation[1, 0], rotation[0, 0])), tilt_of(rotation)


def tilt_of(rotation: np.ndarray) -> float:
    """Return the angle between the z axes of a rotated frame and its parent [rad]."""
    return math.acos(min(max(float(rotation[2, 2]), -1.0), 1.0))


def planar_pose(name: str, pose: object) -> tuple[float, float, float]:
    """Return (x, y, yaw) of a pose, which must be level."""
    planar, tilt = planar_part(name, pose)
    if tilt > LEVEL:
        rule = "must be level, with a rotation about z only"
        raise ValueError(f"{name}.orientation: {rule}, got a tilt of {math.degrees(tilt):.3g} deg")
    return planar


def planar_covariance(numbers: Any) -> np.ndarray:
    """Return the (3, 3) covariance of x, y and yaw out of the 36 numbers of geometry_msgs/PoseWithCovariance."""
    part = np.asarray(numbers, np.float64).reshape(6, 6)[np.ix_((0, 1, 5), (0, 1, 5))]
    if not np.isfinite(part).all():
        raise ValueError(f"message.pose.covariance: must be finite, got {part.tolist()}")
    part = 0.5 * (part + part.T)
    least = float(np.linalg.eigvalsh(part).min())
    if least < -_ROUNDING * max(float(part.diagonal().max()), 0.0):
        rule = "must be positive semidefinite"
        raise ValueError(f"message.pose.covariance: {rule}, got an eigenvalue of {least:.3g} for x, y and yaw")
    return part


def distinct_beams(step: float, count: int) -> int:
    """Return the number of beams with distinct directions: one less if the last beam repeats the first."""
    return count - 1 if count > 2 and abs(abs(step) * (count - 1) - 2 * math.pi) < 0.5 * abs(step) else count


def nearest_beams(bearings: NDArray[np.float64], first: float, step: float, count: int) -> NDArray[np.int64]:
    """Return the index of the beam nearest to each bearing; -1 where the nearest beam is over half a step away.

    ``bearings``: (K,) bearings, any number of turns [rad]; ``first``: bearing of beam 0 [rad]; ``step``: step between
    beams [rad].
    """
    turned = bearings - first if step > 0 else first - bearings
    width = abs(step)
    index = np.rint((np.mod(turned + width / 2, 2 * math.pi) - width / 2) / width).astype(np.int64)
    return np.where(index < count, index, -1)


def laser_beams(message: object) -> tuple[float, float, int]:
    """Return angle_min, angle_increment and the number of beams of a ``sensor_msgs/LaserScan``."""
    first, step = (real_field("message", message, name) for name in ("angle_min", "angle_increment"))
    count = len(checks.array("message.ranges", field("message", message, "ranges"), ("K",), finite=False))
    if count > 1 and step == 0:
        raise ValueError(f"message.angle_increment: must not be 0 for {count} beams, got {step:g}")
    return first, step, count


def _range_limit(message: object, name: str, value: float | None, **rule: float) -> float:
    """Return a limit of ranges [m], or the value that replaces it."""
    if value is not None:
        return value
    try:
        return checks.real(f"message.{name}", _number(message, name), **rule)
    except ValueError as error:
        raise ValueError(f"{error}; {name}= replaces it") from None


def laser_geometry(message: object, range_max: float | None = None, range_min: float | None = None) -> dict[str, Any]:
    """Return angle_min, angle_increment, count, range_min and range_max of a ``sensor_msgs/LaserScan``.

    ``range_max``: upper limit instead of the message's [m]; ``range_min``: lower limit instead of the message's [m].
    """
    first, step, count = laser_beams(message)
    nearest = _range_limit(message, "range_min", range_min, low=0)
    farthest = _range_limit(message, "range_max", range_max, above=0)
    return dict(angle_min=first, angle_increment=step, count=count, range_min=nearest, range_max=farthest)
