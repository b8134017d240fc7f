"""Extract a node's parameters, and the robot's first pose, from a parameter file of ROS 2."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Iterator, Mapping
from typing import Any

import numpy as np

from gpusense._util import checks

Row = tuple[float, float, float]
Matrix = tuple[Row, Row, Row]

_START = "initial_pose"
_POSE = tuple(f"{_START}.{each}" for each in ("x", "y", "yaw"))
# The upper triangle, row by row.
_COVARIANCES = tuple(f"{_START}.covariance_{each}" for each in ("x", "xy", "xyaw", "y", "yyaw", "yaw"))
START_NAMES = (*_POSE, *_COVARIANCES)
_OWN = "ros__parameters"
# Mappings in a file of gpusense fit that are no nodes.
FITTED = ("beam_model", "incidence_model", "odometry_motion")
ROS_1 = {
    "odom_model_type": "robot_model_type", "kld_err": "pf_err", "kld_z": "pf_z", "laser_max_beams": "max_beams",
    "initial_pose_x": "initial_pose.x", "initial_pose_y": "initial_pose.y", "initial_pose_a": "initial_pose.yaw",
    **{f"odom_alpha{k}": f"alpha{k}" for k in range(1, 6)},
    **{f"laser_{name}": name for name in ("z_hit", "z_short", "z_max", "z_rand", "sigma_hit", "lambda_short")},
}  # fmt: skip
"""Names of the parameters of amcl in ROS 1, and their names in ROS 2."""


def parameters_of(content: Mapping[str, Any], name: str, node: str | None, known: Collection[str]) -> dict[str, Any]:
    """Return the parameters of a node by dotted names, or of the only node named amcl for None.

    As in rclcpp, ``*`` in the name of a node matches one level, ``**`` any number of levels, and the last matching
    wildcard wins. The exact name wins over wildcards.

    A mapping within the parameters is equivalent to dotted names: ``initial_pose: {x: 1}`` is ``initial_pose.x: 1``.
    """
    if node is not None and not isinstance(node, str):
        raise TypeError(f"node: must be a string or None, got {checks.show(node)}")
    if any(key in content for key in (*known, *ROS_1)):
        if node is not None:
            raise ValueError(f"node: must be None where source has the parameters themselves, got {checks.show(node)}")
        _refuse_ros_1(content, name)
        return _dotted(content, name)
    nodes = list(nodes_of(content))
    wanted = "amcl" if node is None else node.strip("/")
    exact = [path for path, _ in nodes if "*" not in path and path.endswith(f"/{wanted}")]
    if len(exact) > 1 and node is not None:
        exact = [path for path in exact if path == f"/{wanted}"] or exact
    if len(exact) > 1:
        raise ValueError(f"node: must name one of {checks.show(sorted(exact))} in {name}, got {checks.show(node)}")
    full = exact[0] if exact else f"/{wanted}"
    matching = [(path, _dotted(own, name)) for path, own in nodes if _matches(path, full)]
    if matching:
        found = _merged(matching, full, name)
        if old := _ros_1_names(found):
            warnings.warn(f"{name}: names of ROS 1's amcl have no effect in ROS 2: {old}", stacklevel=2)
        return {key: value for key, value in found.items() if not exact or key in known or key in matching[-1][1]}
    if node is not None or any("*" in path for path, _ in nodes):
        paths = sorted(path for path, _ in nodes)
        raise ValueError(f"node: must be a node of {name}, one of {checks.show(paths)}, got {checks.show(node)}")
    if "beam_model" in content:
        return {"laser_model_type": "beam"}
    if "odometry_motion" in content:
        return {}
    if isinstance(content.get("amcl"), Mapping):
        _refuse_ros_1(content["amcl"], name)
    raise ValueError(f"{name}: must hold amcl's {_OWN}, got the keys {checks.show(sorted(map(str, content)))}")


def _matches(pattern: str, node: str) -> bool:
    """Return whether a name with wildcards matches the name of a node."""
    levels = node.split("/")[1:]
    ends = {0}
    for part in pattern.split("/")[1:]:
        if part == "**":
            ends = set(range(min(ends), len(levels) + 1)) if ends else ends
        else:
            ends = {end + 1 for end in ends if end < len(levels) and part in ("*", levels[end])}
    return len(levels) in ends


def _merged(matching: list[tuple[str, dict[str, Any]]], full: str, name: str) -> dict[str, Any]:
    """Merge the parameters under all matching names of a node, and move the exact name to the end.

    In rclcpp the last name in the file wins, exact or not. A warning names the parameters that differ there.
    """
    found: dict[str, Any] = {}
    in_order: dict[str, Any] = {}
    for _, own in matching:
        in_order |= own
    matching.sort(key=lambda one: one[0] == full)
    for _, own in matching:
        found |= own
    later = [key for key in found if found[key] != in_order[key]]
    if later:
        warnings.warn(
            f"{name}: {full}: {', '.join(later)} is also set under a wildcard further down, which wins in ROS 2; "
            "the value under the exact name is used",
            stacklevel=2,
        )
    return found


def _refuse_ros_1(values: Mapping[Any, Any], name: str) -> None:
    """Refuse parameter names of ROS 1, since the defaults differ."""
    if old := _ros_1_names(values):
        raise ValueError(f"{name}: must have amcl's names in ROS 2, got names of ROS 1: {old}")


def _ros_1_names(values: Mapping[Any, Any]) -> str:
    """Return a text of names from ROS 1, each with its name in ROS 2."""
    return ", ".join(f"{old} (now {new})" for old, new in ROS_1.items() if old in values)


def _dotted(values: Mapping[Any, Any], name: str) -> dict[str, Any]:
    """Return parameters by dotted names."""
    flat: dict[str, Any] = {}
    for key, value in values.items():
        inner = isinstance(value, Mapping) and str(key) not in FITTED
        parts = {f"{key}.{each}": one for each, one in _dotted(value, name).items()} if inner else {str(key): value}
        for each, one in parts.items():
            if each in flat and flat[each] != one:
                raise ValueError(f"{name}: {each}: must have one value, got {checks.show(flat[each])} and {one!r}")
            flat[each] = one
    return flat


def nodes_of(content: Mapping[Any, Any], path: str = "") -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield full name and parameters of each node."""
    for key, value in content.items():
        if key in (_OWN, *FITTED) or not isinstance(value, Mapping):
            continue
        here = f"{path}/{str(key).strip('/')}"
        if isinstance(value.get(_OWN), Mapping):
            yield here, value[_OWN]
        yield from nodes_of(value, here)


def first_pose(name: str, parameters: Mapping[str, Any]) -> Row:
    """Return the first pose (x, y, yaw) [m, m, rad] of parameters by dotted names."""
    if _START in parameters:
        raise TypeError(f"{name}: {_START}: must be a mapping, got {checks.show(parameters[_START])}")
    x, y, yaw = (checks.real(f"{name}: {key}", parameters.get(key, 0.0)) for key in _POSE)
    return x, y, yaw


def first_covariance(name: str, parameters: Mapping[str, Any]) -> Matrix | None:
    """Return the covariance of the first pose, or None."""
    if not any(key in parameters for key in _COVARIANCES):
        return None
    xx, xy, xt, yy, yt, tt = (checks.real(f"{name}: {key}", parameters.get(key, 0.0)) for key in _COVARIANCES)
    matrix = (xx, xy, xt), (xy, yy, yt), (xt, yt, tt)
    least = float(np.linalg.eigvalsh(np.array(matrix)).min())
    if least < -1e-9 * max(xx, yy, tt, 0.0):
        raise ValueError(
            f"{name}: {_START}.covariance: must be positive semidefinite, got an eigenvalue of {least:.3g}"
        )
    return matrix
