"""Drift between the poses of two scans: covariances of relative poses in a pose graph."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpusense.chaining.graph import Solution, factored, normal_equations, pose_jacobians

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

# Most poses whose joint covariance is kept; in a longer graph each represents the poses up to the next one. At most
# this share are sides of steps whose variance is this many times the usual one, so that breaks of the chain are
# represented.
_ANCHORS, _BREAKS, _LOOSE = 300, 0.4, 10.0
# Lever by which variances of headings are compared with variances of positions [m].
_LEVER = 3.0
# Columns of the inverse that are solved for at once.
_COLUMNS = 192
# Damping [1/m^2, 1/rad^2]; its inverse is the variance along a direction that no link observes.
DAMPING = 1e-6


class Drift:
    """Covariances of relative poses of a solved pose graph.

    Args:
        solution: The poses and links.
        most: Most poses whose joint covariance is kept, at least 3; another pose takes the covariance of the nearest
            kept one before it.

    Attributes:
        anchors: (A,) numbers of the kept poses, ascending.
    """

    def __init__(self, solution: Solution, most: int = _ANCHORS) -> None:
        count = len(solution.poses)
        self._poses = solution.poses
        self.anchors = anchors = _anchors_of(solution, most)
        self._joint = np.zeros((len(anchors), 3, len(anchors), 3))
        if count < 2:
            return
        matrix, _ = normal_equations(solution.poses, solution.links, solution.links.weight, 0)
        # The first pose is known, so its rows and columns are 0.
        rows = (3 * (anchors[1:, None] - 1) + np.arange(3)).ravel()
        joint = _inverse_part(matrix, rows)
        self._joint[1:, :, 1:, :] = joint.reshape(len(anchors) - 1, 3, len(anchors) - 1, 3)

    def relative(self, first: Integers, second: Integers) -> Floats:
        """Return the covariances (L, 3, 3) of the poses of second scans in the frames of first ones."""
        a, b = (np.searchsorted(self.anchors, scans, "right") - 1 for scans in (first, second))
        one, two = pose_jacobians(self._poses, self.anchors[a], self.anchors[b])
        side = one @ self._joint[a, :, b, :] @ two.transpose(0, 2, 1)
        total = one @ self._joint[a, :, a, :] @ one.transpose(0, 2, 1)
        total += two @ self._joint[b, :, b, :] @ two.transpose(0, 2, 1)
        result: Floats = total + side + side.transpose(0, 2, 1)
        return result


def _anchors_of(solution: Solution, most: int) -> Integers:
    """Return the poses whose joint covariance is kept: evenly spaced ones, and both sides of the loosest steps."""
    count = len(solution.poses)
    if count <= most:
        return np.arange(count)
    links = solution.links
    information = np.zeros((count, 3, 3))
    follow = np.abs(links.second - links.first) == 1
    later = np.maximum(links.first, links.second)[follow]
    np.add.at(information, later, links.information[follow] * links.weight[follow, None, None])
    spread = np.linalg.inv(information[1:] + DAMPING * np.eye(3))
    variance = spread[:, 0, 0] + spread[:, 1, 1] + _LEVER**2 * spread[:, 2, 2]
    loose = np.flatnonzero(variance > _LOOSE * np.median(variance))
    loose = loose[np.argsort(-variance[loose], kind="stable")][: int(_BREAKS * most / 2)]
    even = np.arange(0, count, -(-count // (most - 2 * len(loose))))
    anchors: Integers = np.unique(np.concatenate([even, loose, loose + 1]))
    return anchors


def _inverse_part(matrix: Any, rows: Integers) -> Floats:
    """Return some rows and columns of the inverse of a sparse matrix, by Schur's complement of all remaining ones."""
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
