"""Convert between ROS messages and NumPy, and check the nodes' parameters, without ROS.

Messages are read by field, and written as plain mappings; ``fill`` copies a mapping into a message.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gpusense._util import checks
from gpusense.evaluation.tracking import RISK
from gpusense.localization.nav2 import DEFAULTS, Nav2Options, from_nav2
from gpusense.localization.spread import check_risk
from gpusense.logs.bag_beams import Beams, alike
from gpusense.logs.records import Pose, planar_mount, pose_fields
from gpusense.world.messages import field, laser_beams, planar_covariance, planar_pose
from gpusense.world.pose_algebra import compose_poses, invert_poses
from gpusense.world.scanner import Scanner

PLACES = 1440
"""Beams of the common scanner for varying beams."""
# Least difference of distinct mounts [m, rad]: a body on springs moves a laser by millimetres.
_SAME_MOUNT = 5e-3


def pose_matrix(pose: Pose) -> np.ndarray:
    """Return the (4, 4) matrix of a planar pose."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return np.array([[c, -s, 0, pose[0]], [s, c, 0, pose[1]], [0, 0, 1, 0], [0, 0, 0, 1]])


def map_to_odometry(in_map: Pose, in_odometry: Pose) -> Pose:
    """Return the pose of the odometry frame in the map, from the base's poses in both."""
    x, y, yaw = compose_poses(in_map, invert_poses(in_odometry)).tolist()
    return x, y, yaw


def moved_enough(before: Pose, after: Pose, least: tuple[float, float]) -> bool:
    """Return whether the robot moved by ``least`` (m along x or y, rad), nav2_amcl's condition for an update."""
    turn = abs(math.remainder(after[2] - before[2], 2 * math.pi))
    return abs(after[0] - before[0]) > least[0] or abs(after[1] - before[1]) > least[0] or turn > least[1]


def covariance_fields(covariance: np.ndarray) -> list[float]:
    """Return the 36 numbers of geometry_msgs/PoseWithCovariance for a (3, 3) covariance of x, y and yaw."""
    full = np.zeros((6, 6))
    full[np.ix_((0, 1, 5), (0, 1, 5))] = covariance
    return [float(value) for value in full.ravel()]


def start_of(message: Any, frame: str) -> tuple[Pose, np.ndarray]:
    """Return the pose and the (3, 3) covariance of a PoseWithCovarianceStamped, which must be in ``frame``."""
    named = str(field("message", message, "header.frame_id")).strip("/")
    if named != frame.strip("/"):
        raise ValueError(f"message.header.frame_id: must be {frame!r}, got {named!r}")
    pose = planar_pose("message.pose", field("message", message, "pose.pose"))
    return pose, planar_covariance(field("message", message, "pose.covariance"))


def odometry_fields(message: Any, frames: tuple[str, str]) -> dict[str, Any]:
    """Return a nav_msgs/Odometry as the fields of geometry_msgs/TransformStamped between two frames."""
    pose = message.pose.pose
    return {
        "header": {"stamp": message.header.stamp, "frame_id": frames[0]}, "child_frame_id": frames[1],
        "transform": {"translation": pose.position, "rotation": pose.orientation},
    }  # fmt: skip


def laser_scan(
    message: Any, laser: np.ndarray, limits: tuple[float | None, float | None]
) -> tuple[Scanner, dict[str, Any]]:
    """Return the scanner of a sensor_msgs/LaserScan, and the fields of its readings.

    Beams of an upside-down ``laser`` (4, 4) run clockwise. ``limits`` [m] narrow the message's ``range_min`` and
    ``range_max``, as in nav2_amcl, or replace invalid ones.
    """
    mount, upside_down, _ = planar_mount(laser)
    names = ("angle_min", "angle_increment", "range_min", "range_max", "ranges")
    fields = {name: field("message", message, name) for name in names}
    if upside_down:
        fields |= {name: -fields[name] for name in names[:2]}
    (near, far), nearest, farthest = limits, fields["range_min"], fields["range_max"]
    if far is not None and not 0 < farthest <= far:
        farthest = far
    if near is not None and not near <= nearest < farthest:
        nearest = near
    scanner = Scanner.from_laser_scan(fields, mount, range_max=farthest, range_min=nearest)
    return scanner, fields | {"range_min": scanner.range_min, "range_max": scanner.range_max}


class CommonBeams:
    """Readings of a laser's scans on the beams of one ``scanner``, as in logs.

    The first scan's geometry is the scanner. After a scan of another geometry, all scans move to common bearings, so
    that varying beams need only a second scanner. Each move of the mount needs a new scanner. Readings of 0 are
    missing, and each scan keeps its limits.
    """

    def __init__(self) -> None:
        self.scanner: Scanner | None = None
        self._beams: Beams | None = None

    def take(self, scanner: Scanner, fields: Mapping[str, Any]) -> np.ndarray:
        """Return the readings of a scan, from the results of ``laser_scan``; ``scanner`` may become another object."""
        angles, limits = laser_beams(fields), (scanner.range_min, scanner.range_max)
        if self._beams is None or self.scanner is None:
            self._beams, self.scanner = Beams(*angles, *limits), scanner
        elif not (self._beams.varied or alike((self._beams.first, self._beams.step, self._beams.count), angles)):
            self._beams = Beams(-math.pi, 2 * math.pi / PLACES, PLACES, *limits, varied=True)
            self.scanner = self._beams.scanner(scanner.mount, upside_down=False)
        elif not np.allclose(self.scanner.mount, scanner.mount, rtol=0, atol=_SAME_MOUNT):
            self.scanner = self._beams.scanner(scanner.mount, upside_down=False)
        return self._beams.take(fields)[0]


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


OK, WARN, ERROR, STALE = 0, 1, 2, 3
LEVELS = {"tracking": OK, "uncertain": WARN, "lost": ERROR}


def status_fields(
    name: str, level: int, message: str, values: Mapping[str, str], node: str = "gpusense"
) -> dict[str, Any]:
    """Return the fields of diagnostic_msgs/DiagnosticStatus; ``node`` distinguishes robots."""
    pairs = [{"key": key, "value": value} for key, value in values.items()]
    return {"name": f"{node}: {name}", "hardware_id": node, "level": level, "message": message, "values": pairs}


OWN: dict[str, Any] = {
    "parameters": "", "node": "", "backend": "auto", "autostart_node": False, "map_file": "", "odom_topic": "",
    "mount": [], "scan_patience": 5.0, "restart_after_jump": False, "seed": 0, "risk": RISK,
    "initial_pose.x": 0.0, "initial_pose.y": 0.0, "initial_pose.yaw": 0.0,
}  # fmt: skip
"""Parameters beyond nav2_amcl's, with defaults."""

# Parameters without effect.
_IDLE = ("max_beams", "pf_err", "pf_z", "resample_interval")
# Parameters of every node of ROS 2.
_ROS = ("use_sim_time", "qos_overrides", "start_type_description_service")


def defaults() -> dict[str, Any]:
    """Return the parameters to declare, with their defaults."""
    return DEFAULTS | OWN


def options_of(values: Mapping[str, Any]) -> tuple[Nav2Options, tuple[str, ...]]:
    """Return options by dotted names, of the file ``parameters`` if set, and names without effect."""
    _check_own(values)
    first = {name: value for name, value in values.items() if name.startswith("initial_pose.")}
    first["set_initial_pose"] = values["set_initial_pose"]
    if values["parameters"]:
        options = from_nav2(values["parameters"], node=values["node"] or None)
        if values["set_initial_pose"]:
            start = from_nav2(first)
            options = dataclasses.replace(
                options, initial_pose=start.initial_pose, initial_covariance=start.initial_covariance
            )
        return options, options.ignored
    options = from_nav2({name: value for name, value in values.items() if name not in OWN} | first)
    unknown = [name for name in options.ignored if name.partition(".")[0] not in _ROS]
    idle = [name for name in _IDLE if values[name] != DEFAULTS[name]]
    return options, tuple(sorted(unknown + idle))


def _check_own(values: Mapping[str, Any]) -> None:
    for name in OWN:
        value, default = values[name], OWN[name]
        if isinstance(default, (bool, str)) and not isinstance(value, type(default)):
            raise TypeError(f"{name}: must be {type(default).__name__}, got {checks.show(value)}")
    checks.real("scan_patience", values["scan_patience"], above=0)
    checks.integer("seed", values["seed"], low=0)
    check_risk(values["risk"])
    mount_of(values["mount"])
    for name in ("parameters", "map_file"):
        if values[name]:
            checks.existing_file(Path(values[name]))


def mount_of(value: Any) -> tuple[float, float, float] | None:
    """Return the pose (x, y, yaw) of the laser on the robot; None to use transforms."""
    if not len(value):
        return None
    x, y, yaw = checks.array("mount", list(value), (3,)).tolist()
    return x, y, yaw


WATCH: dict[str, Any] = {
    "backend": "auto", "base_frame": "base_footprint", "global_frame_id": "map", "laser_max_range": 100.0,
    "map_file": "", "mount": [], "patience": 10.0, "risk": RISK, "tolerance": 0.05,
}  # fmt: skip
"""Parameters of the watching node, with their defaults."""


def check_watch(values: Mapping[str, Any]) -> None:
    """Check the parameters of the watching node."""
    for name in ("laser_max_range", "patience", "tolerance"):
        checks.real(name, values[name], above=0)
    check_risk(values["risk"])
    mount_of(values["mount"])
