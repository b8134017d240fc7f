"""Parameters of the nodes by the names of nav2_amcl, without ROS."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gpusense._util import checks
from gpusense.evaluation.tracking import RISK
from gpusense.localization.nav2 import DEFAULTS, Nav2Options, from_nav2
from gpusense.localization.protection import check_risk

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
    """Return the options of parameters by dotted names, and the names of parameters that have no effect.

    A file named by ``parameters`` replaces nav2_amcl's parameters, except a first pose.
    """
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
