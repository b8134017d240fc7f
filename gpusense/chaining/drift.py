"""How far the poses of two scans may have drifted apart: covariances of relative poses in a pose graph."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpusense.chaining.graph import Solution, factored, normal_equations, pose_jacobians

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

# Most poses whose joint covariance is kept; in a longer graph each stands for its neighbours.
_ANCHORS = 300
# Columns of the inverse that are solved for at once.
_COLUMNS = 192
# Damping [1/m^2, 1/rad^2]: a direction that no link observes has a variance of the inverse.
DAMPING = 1e-6


class Drift:
    """Covariances of relative poses of a solved pose graph.

    Args:
        solution: The poses and links.
        most: Most poses whose joint covariance is kept; another pose takes the covariance of the nearest kept one
            before it.
    """

    def __init__(self, solution: Solution, most: int = _ANCHORS) -> None:
        count = len(solution.poses)
        self._poses, self._stride = solution.poses, -(-count // most)
        anchors = np.arange(0, count, self._stride)
        self._joint = np.zeros((len(anchors), 3, len(anchors), 3))
        if count < 2:
            return
        matrix, _ = normal_equations(solution.poses, solution.links, solution.links.weight, 0)
        # The first pose is known: its rows and columns are 0.
        rows = (3 * (anchors[1:, None] - 1) + np.arange(3)).ravel()
        joint = _inverse_part(matrix, rows)
        self._joint[1:, :, 1:, :] = joint.reshape(len(anchors) - 1, 3, len(anchors) - 1, 3)

    def relative(self, first: Integers, second: Integers) -> Floats:
        """Return the covariances (L, 3, 3) of the poses of second scans in the frames of first ones."""
        a, b = first // self._stride, second // self._stride
        one, two = pose_jacobians(self._poses, a * self._stride, b * self._stride)
        side = one @ self._joint[a, :, b, :] @ two.transpose(0, 2, 1)
        total = one @ self._joint[a, :, a, :] @ one.transpose(0, 2, 1)
        total += two @ self._joint[b, :, b, :] @ two.transpose(0, 2, 1)
        result: Floats = total + side + side.transpose(0, 2, 1)
        return result


def _inverse_part(matrix: Any, rows: Integers) -> Floats:
    """Return some rows and columns of the inverse of a sparse matrix, by Schur's complement of the others."""
    from scipy.sparse import identity

    damped = (matrix + DAMPING * identity(matrix.shape[0], format="csc")).tocsc()
    others = np.setdiff1d(np.arange(matrix.shape[0]), rows)
    left: Floats = damped[rows][:, rows].toarray()
    if len(others):
        side, factor = damped[others][:, rows].tocsc(), factored(matrix[others][:, others].tocsc(), DAMPING)
        for begin in range(0, len(rows), _COLUMNS):
            part = slice(begin, begin + _COLUMNS)
            left[:, part] -= side.T @ factor.solve(side[:, part].toarray())
    inverse: Floats = np.asarray(np.linalg.inv(0.5 * (left + left.T)), np.float64)
    result: Floats = 0.5 * (inverse + inverse.T)
    return result
