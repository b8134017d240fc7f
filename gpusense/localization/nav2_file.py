"""Parameters in a file of ROS 2: those of one node, and the robot's first pose among them."""

from __future__ import annotations

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
# Mappings of a file of gpusense fit that hold no nodes.
FITTED = ("beam_model", "incidence_model", "odometry_motion")


def parameters_of(content: Mapping[str, Any], name: str, node: str | None, known: Collection[str]) -> dict[str, Any]:
    """Return the parameters of a node by dotted names; as in ROS, ``/**`` supplies the parameters that the node lacks.

    A mapping within the parameters is equivalent to dotted names: ``initial_pose: {x: 1}`` is ``initial_pose.x: 1``.

    Args:
        content: The content of a file, or the mapping of the parameters themselves.
        name: Name of the file.
        node: Name of the node, with or without its namespaces; None for the only node named amcl.
        known: Names of amcl's parameters.

    Raises:
        TypeError: ``node`` is no string.
        ValueError: There is no such node, or more than one; or a parameter has two values.
    """
    if node is not None and not isinstance(node, str):
        raise TypeError(f"node: must be a string or None, got {checks.show(node)}")
    if any(key in content for key in known):
        if node is not None:
            raise ValueError(f"node: must be None where source has the parameters themselves, got {checks.show(node)}")
        return _dotted(content, name)
    found = list(nodes_of(content))
    anywhere = {key: value for path, own in found if path == "/**" for key, value in _dotted(own, name).items()}
    own_nodes = [(path, own) for path, own in found if path != "/**"]
    wanted = "amcl" if node is None else node.strip("/")
    chosen = [(path, own) for path, own in own_nodes if f"/{path}".endswith(f"/{wanted}")]
    if len(chosen) > 1 and node is not None:
        chosen = [one for one in chosen if one[0].strip("/") == wanted] or chosen
    if len(chosen) > 1:
        paths = sorted(path for path, _ in chosen)
        raise ValueError(f"node: must name one of {checks.show(paths)} in {name}, got {checks.show(node)}")
    if chosen:
        return {key: value for key, value in anywhere.items() if key in known} | _dotted(chosen[0][1], name)
    if node is not None:
        paths = sorted(path for path, _ in own_nodes)
        raise ValueError(f"node: must be a node of {name}, one of {checks.show(paths)}, got {checks.show(node)}")
    if anywhere or any(path == "/**" for path, _ in found):
        return anywhere
    if "beam_model" in content:
        return {"laser_model_type": "beam"}
    if "odometry_motion" in content:
        return {}
    raise ValueError(f"{name}: must hold amcl's {_OWN}, got the keys {checks.show(sorted(map(str, content)))}")


def _dotted(values: Mapping[Any, Any], name: str) -> dict[str, Any]:
    """Return parameters by dotted names.

    Raises:
        ValueError: A parameter has two values, one by its dotted name and one in a mapping.
    """
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
    """Return the first pose (x, y, yaw) [m, m, rad].

    Args:
        name: Name of the file.
        parameters: Parameters by dotted names.

    Raises:
        TypeError, ValueError: A part is no finite number.
    """
    if _START in parameters:
        raise TypeError(f"{name}: {_START}: must be a mapping, got {checks.show(parameters[_START])}")
    x, y, yaw = (checks.real(f"{name}: {key}", parameters.get(key, 0.0)) for key in _POSE)
    return x, y, yaw


def first_covariance(name: str, parameters: Mapping[str, Any]) -> Matrix | None:
    """Return the covariance of the first pose; None where the file has no part of it.

    Raises:
        TypeError, ValueError: A part is no finite number, or the matrix is not positive semidefinite.
    """
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
