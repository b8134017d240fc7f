"""Poses (x, y, theta) as rigid motions of the plane: products, inverses, differences, means, and rotations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from gpusense._util import checks
from gpusense._util.angles import wrapped
from gpusense._util.typing import AnyArray

# Largest coordinate [m], so that sums stay finite.
_LARGEST = 1e300


def wrap_angle(angle: AnyArray) -> np.ndarray:
    """Return angles in [-pi, pi).

    Args:
        angle: Angles [rad], any shape; NaN stays NaN.

    Raises:
        TypeError: Not real numbers.
        ValueError: An angle is infinite.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> float(gs.wrap_angle(3 * np.pi / 2) / np.pi)
        -0.5
    """
    values = checks.array("angle", angle, finite=False)
    if np.isinf(values).any():
        raise ValueError(f"angle: every value must be finite or NaN, got {checks.show(values[np.isinf(values)][0])}")
    return wrapped(values)


def compose_poses(first: AnyArray, second: AnyArray) -> np.ndarray:
    """Return the poses in the world of ``second`` in the frames of ``first``.

    Args:
        first: (..., 3) poses [m, m, rad].
        second: (..., 3) poses that broadcast with ``first``.

    Raises:
        TypeError, ValueError: not poses.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> gs.compose_poses([1.0, 2.0, np.pi / 2], [1.0, 0.0, 0.0]).round(3).tolist()
        [1.0, 3.0, 1.571]
    """
    return composed(*_pair("first", first, "second", second))


def composed(one: np.ndarray, two: np.ndarray) -> np.ndarray:
    """Return the product of poses (..., 3); not checked, so that NaN stays NaN."""
    cosine, sine = np.cos(one[..., 2]), np.sin(one[..., 2])
    x = one[..., 0] + cosine * two[..., 0] - sine * two[..., 1]
    y = one[..., 1] + sine * two[..., 0] + cosine * two[..., 1]
    return np.stack([x, y, wrapped(one[..., 2] + two[..., 2])], axis=-1)


def invert_poses(poses: AnyArray) -> np.ndarray:
    """Return the poses of the world in the frames of ``poses``.

    Args:
        poses: (..., 3) poses [m, m, rad].

    Raises:
        TypeError, ValueError: not poses.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> gs.invert_poses([1.0, 2.0, np.pi / 2]).round(3).tolist()
        [-2.0, 1.0, -1.571]
    """
    return inverted(_poses("poses", poses))


def inverted(pose: np.ndarray) -> np.ndarray:
    """Return the inverses of poses (..., 3); not checked, so that NaN stays NaN."""
    cosine, sine = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    x = -cosine * pose[..., 0] - sine * pose[..., 1]
    y = sine * pose[..., 0] - cosine * pose[..., 1]
    return np.stack([x, y, wrapped(-pose[..., 2])], axis=-1)


def pose_difference(before: AnyArray, after: AnyArray) -> np.ndarray:
    """Return the poses ``after`` in the frames of ``before``: the motion between two readings of an odometer.

    Args:
        before: (..., 3) poses [m, m, rad].
        after: (..., 3) poses that broadcast with ``before``.

    Raises:
        TypeError, ValueError: not poses.

    Example:
        >>> import gpusense as gs, numpy as np
        >>> gs.pose_difference([0.0, 0.0, np.pi / 2], [0.0, 2.0, np.pi]).round(3).tolist()
        [2.0, 0.0, 1.571]
    """
    one, two = _pair("before", before, "after", after)
    return composed(inverted(one), two)


def mean_pose(poses: AnyArray, weights: AnyArray | None = None) -> np.ndarray:
    """Return the weighted mean of poses; the heading is the circular mean.

    Args:
        poses: (N, 3) poses [m, m, rad], N > 0.
        weights: (N,) weights >= 0 with a positive sum; None for equal weights.

    Raises:
        TypeError, ValueError: not poses, or not weights.

    Example:
        >>> import gpusense as gs
        >>> gs.mean_pose([(0.0, 0.0, 3.0), (2.0, 0.0, -3.0)]).round(3).tolist()
        [1.0, 0.0, 3.142]
    """
    values = checks.array("poses", poses, ("N", 3), largest=_LARGEST)
    if not len(values):
        raise ValueError("poses: must hold at least one pose, got shape (0, 3)")
    w = np.ones(len(values)) if weights is None else checks.array("weights", weights, (len(values),))
    if not (w.min() >= 0 and w.max() > 0):
        raise ValueError(f"weights: must be >= 0 and have a positive sum, got {checks.show(w)}")
    w = w / w.max()
    w = w / w.sum()
    heading = np.arctan2(w @ np.sin(values[:, 2]), w @ np.cos(values[:, 2]))
    return np.array([w @ values[:, 0], w @ values[:, 1], heading])


def rotated(vectors: Any, angle: Any) -> np.ndarray:
    """Return (..., 2) vectors turned by angles [rad] that broadcast with them; not checked."""
    cosine, sine = np.cos(angle), np.sin(angle)
    x, y = vectors[..., 0], vectors[..., 1]
    return np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)


def rotations(angle: Any) -> np.ndarray:
    """Return (..., 3, 3) matrices that turn the positions of poses by angles (...) [rad] and keep headings."""
    result = np.zeros((*np.shape(angle), 3, 3))
    result[..., 0, 0] = result[..., 1, 1] = np.cos(angle)
    result[..., 1, 0] = np.sin(angle)
    result[..., 0, 1] = -result[..., 1, 0]
    result[..., 2, 2] = 1.0
    return result


def sensor_poses(poses: np.ndarray, mount: Sequence[float]) -> np.ndarray:
    """Return the (N, 3) poses of a sensor with a mount (x, y, yaw) on a robot at (N, 3) poses; not checked."""
    offset = rotated(np.array([mount[:2]]), poses[:, 2])
    return poses + np.column_stack([offset, np.full(len(poses), mount[2])])


def interpolated(time: Any, times: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """Return (..., 3) poses at times (...) by linear interpolation of (T, 3) poses with headings without jumps."""
    return np.stack([np.interp(time, times, column) for column in poses.T], axis=-1)


def _poses(name: str, poses: object) -> np.ndarray:
    values = checks.array(name, poses, largest=_LARGEST)
    if values.shape[-1:] != (3,):
        raise ValueError(f"{name}: shape must be (..., 3), got {checks.shape_text(values.shape)}")
    return values


def _pair(name: str, poses: object, other_name: str, others: object) -> tuple[np.ndarray, np.ndarray]:
    """Return two arrays of poses whose shapes broadcast."""
    one, two = checks.broadcast({name: _poses(name, poses), other_name: _poses(other_name, others)})
    return one, two
