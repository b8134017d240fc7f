"""Find the parameters of one node in a file of ROS 2's parameters."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from typing import Any

from gpusense._util import checks

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
