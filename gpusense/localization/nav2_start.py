"""Find the initial pose in the parameters of nav2_amcl's node, and the initial covariance in those of Beluga's node."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from gpusense._util import checks

Row = tuple[float, float, float]
Matrix = tuple[Row, Row, Row]

_START = "initial_pose"
_POSE = tuple(f"{_START}.{each}" for each in ("x", "y", "yaw"))
# The upper triangle, row by row.
_COVARIANCES = tuple(f"{_START}.covariance_{each}" for each in ("x", "xy", "xyaw", "y", "yyaw", "yaw"))
NAMES = (*_POSE, *_COVARIANCES)


def pose(name: str, parameters: Mapping[str, Any]) -> Row:
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


def covariance(name: str, parameters: Mapping[str, Any]) -> Matrix | None:
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
