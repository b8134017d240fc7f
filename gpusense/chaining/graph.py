"""Solve a pose graph by sparse least squares with a robust kernel.

The cost is the sum over links of c^2 log(1 + s / c^2), Cauchy's kernel of the squared distance s = r' I r of a link's
residual r in deviations (I is its information). Reweighted Gauss-Newton steps, damped as by Levenberg, minimise it; the
normal equations are sparse and are factored by SuperLU. Poses are relative to a fixed pose. Information may be 0 in
some directions of some or even all links: an undetermined direction keeps its initial value.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpusense.chaining.links import Links
from gpusense.localization.pose_algebra import wrap_angle

Floats = NDArray[np.float64]

# Scale of Cauchy's kernel [deviations of a link].
KERNEL = 3.0
# Most iterations, the step that ends them [m, rad], and the first, least and largest damping.
_ITERATIONS, _SMALL = 50, 1e-6
_DAMPING, _LEAST, _MOST = 1e-6, 1e-9, 1e6
# Columns that are factored at once: fewer than SuperLU's default, since few columns of a pose graph are alike.
_PANEL = 4
# Information that damping multiplies, of 1 m and 1 rad.
_UNIT = 1.0


@dataclass(frozen=True, eq=False)
class Solution:
    """Poses of a pose graph.

    Attributes:
        poses: (N, 3) poses; the fixed one is unchanged.
        links: The links with their weights.
        cost: The minimum.
        iterations: Iterations.
    """

    poses: Floats
    links: Links
    cost: float
    iterations: int


def solve(poses: Floats, links: Links, *, fixed: int = 0, kernel: float = KERNEL, least: float = 1e-7) -> Solution:
    """Return the poses near initial ones that agree best with links.

    Args:
        poses: (N, 3) poses to begin with [m, m, rad].
        links: Links between them; their weights are ignored.
        fixed: Index of the pose that is kept.
        kernel: Scale of Cauchy's kernel [deviations]; infinity for plain least squares.
        least: Relative gain of the cost below which the iterations end.
    """
    at, damping = np.array(poses, np.float64), _DAMPING
    squared = links.squared_distances(at)
    cost, count = _cost(squared, kernel), 0
    if len(at) < 2 or not len(links):
        return Solution(at, replace(links, weight=_weights(squared, kernel)), cost, 0)
    while count < _ITERATIONS:
        count += 1
        matrix, gradient = normal_equations(at, links, _weights(squared, kernel), fixed)
        step = factored(matrix, damping).solve(-gradient)
        trial = moved(at, step, fixed)
        squared_there = links.squared_distances(trial)
        cost_there = _cost(squared_there, kernel)
        if not cost_there <= cost * (1 + 1e-12):
            damping = min(10 * max(damping, 1e-4), _MOST)
            if damping >= _MOST:
                break
            continue
        gain = cost - cost_there
        at, squared, cost, damping = trial, squared_there, cost_there, max(damping / 10, _LEAST)
        if np.abs(step).max() < _SMALL or gain <= least * cost:
            break
    return Solution(at, replace(links, weight=_weights(squared, kernel)), cost, count)


def normal_equations(poses: Floats, links: Links, weight: Floats, fixed: int) -> tuple[Any, Floats]:
    """Return the sparse matrix of the normal equations of the free poses, and the gradient."""
    from scipy import sparse

    one, two = pose_jacobians(poses, links.first, links.second)
    information = links.information * weight[:, None, None]
    residual = links.residuals(poses)
    size = len(poses)
    gradient = np.zeros((size, 3))
    side = np.einsum("lij,lj->li", information, residual)
    rows, cols, blocks = [], [], []
    ends = ((links.first, one), (links.second, two))
    for node, jacobian in ends:
        np.add.at(gradient, node, np.einsum("lij,li->lj", jacobian, side))
        for other, across in ends:
            rows.append(node)
            cols.append(other)
            blocks.append(jacobian.transpose(0, 2, 1) @ information @ across)
    row, col, block = (np.concatenate(part) for part in (rows, cols, blocks))
    free = (row != fixed) & (col != fixed)
    row, col, block = row[free], col[free], block[free]
    row, col = row - (row > fixed), col - (col > fixed)
    k = np.arange(3)
    i = np.broadcast_to((3 * row)[:, None, None] + k[:, None], block.shape)
    j = np.broadcast_to((3 * col)[:, None, None] + k, block.shape)
    matrix = sparse.csc_matrix((block.ravel(), (i.ravel(), j.ravel())), shape=(3 * (size - 1), 3 * (size - 1)))
    return matrix, np.delete(gradient, fixed, axis=0).ravel()


def pose_jacobians(poses: Floats, first: NDArray[np.int64], second: NDArray[np.int64]) -> tuple[Floats, Floats]:
    """Return the derivatives (L, 3, 3) of relative poses by the first and by the second pose."""
    c, s = np.cos(poses[first, 2]), np.sin(poses[first, 2])
    off = poses[second] - poses[first]
    x, y = c * off[:, 0] + s * off[:, 1], c * off[:, 1] - s * off[:, 0]
    zero, one = np.zeros(len(c)), np.ones(len(c))
    one_side = np.stack([-c, -s, y, s, -c, -x, zero, zero, -one], axis=1).reshape(-1, 3, 3)
    other_side = np.stack([c, s, zero, -s, c, zero, zero, zero, one], axis=1).reshape(-1, 3, 3)
    return one_side, other_side


def moved(poses: Floats, step: Floats, fixed: int) -> Floats:
    """Return poses after a step (3 N - 3,) of the free ones."""
    result = poses.copy()
    free = np.arange(len(poses)) != fixed
    result[free] += step.reshape(-1, 3)
    result[:, 2] = wrap_angle(result[:, 2])
    return result


def factored(matrix: Any, damping: float) -> Any:
    """Return the factors of a matrix with damping."""
    from scipy.sparse import identity
    from scipy.sparse.linalg import splu

    # Symmetric and positive definite: a symmetric order without pivots.
    damped = (matrix + damping * _UNIT * identity(matrix.shape[0], format="csc")).tocsc()
    options = {"SymmetricMode": True}
    return splu(damped, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, relax=1, panel_size=_PANEL, options=options)


def _weights(squared: Floats, kernel: float) -> Floats:
    """Return Cauchy's weights of links by their squared distances."""
    weights: Floats = 1 / (1 + squared / kernel**2) if np.isfinite(kernel) else np.ones(len(squared))
    return weights


def _cost(squared: Floats, kernel: float) -> float:
    """Return the sum of Cauchy's kernels."""
    return float(np.sum(kernel**2 * np.log1p(squared / kernel**2) if np.isfinite(kernel) else squared))
