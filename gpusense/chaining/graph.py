"""Solve a pose graph by sparse least squares with a robust kernel.

The cost is the sum over links of c^2 log(1 + s / c^2), Cauchy's kernel of the squared distance s = r' I r of a link's
residual r in deviations (I is its information). Reweighted Gauss-Newton steps, damped as by Levenberg, minimise it; the
normal equations are sparse and are factored by SuperLU. The first pose is fixed. Information may be 0 along directions
of some or all links: an undetermined direction keeps its initial value.

A step changes the poses in the world or, with ``settle``, the motions from pose to pose if that costs less. Both are
equal to first order, but the former suits a loose pose among firm ones, the latter a long chain that turns. Damping is
then per pose [1/m^2, 1/rad^2], so that a few loose poses in curved valleys of the cost do not delay all others.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpusense._util.typing import Flags, Floats, Integers
from gpusense.chaining.links import Links, chained
from gpusense.world.pose_algebra import pose_difference, wrap_angle

# Columns per panel, fewer than SuperLU's default, since few columns of a pose graph are alike.
_PANEL = 4


class Equations:
    """The normal equations of a graph of N poses, the first of which is fixed: its step is 0.

    ``ordered`` puts poses in an order with little fill; ``place`` (N,) is the block of each pose.
    """

    def __init__(self, count: int, first: Integers, second: Integers, *, ordered: bool = False) -> None:
        self.first, self.second, self.place = first, second, np.arange(count)
        if ordered:
            ends = [np.append(one, self.place) for one in ((first, second), (second, first))]
            self.place = np.argsort(order_of(*ends))
        # Links contribute blocks of both poses; damping adds one block per pose.
        self._columns = np.append(self.place[np.stack([first, second], axis=1)], self.place)
        self._starts = np.append(2 * np.arange(len(first)), 2 * len(first) + np.arange(count + 1))

    def at(self, poses: Floats, information: Floats, pull: Floats, damping: Floats) -> tuple[Any, Floats]:
        """Return the sparse matrix (3 N, 3 N) and the gradient (3 N,) at (N, 3) poses.

        ``information`` (L, 3, 3) includes the links' weights, ``pull`` (L, 3) is its product with the residuals, and
        ``damping`` (N,) belongs to the poses.
        """
        from scipy import sparse

        count, links = len(poses), len(self.first)
        both = np.stack(pose_jacobians(poses, self.first, self.second), axis=1)
        both[self.first == 0, 0] = both[self.second == 0, 1] = 0.0
        more = np.tile(np.eye(3), (count, 1, 1))
        weights = np.where(np.arange(count) == 0, 1.0, damping)[:, None, None]
        jacobian, weighted = (
            sparse.bsr_matrix((np.concatenate(parts), self._columns, self._starts), (3 * (links + count), 3 * count))
            for parts in ((both.reshape(-1, 3, 3), more),
                          ((information[:, None] @ both).reshape(-1, 3, 3), weights * more))
        )  # fmt: skip
        # SuperLU reads columns; the matrix is symmetric.
        matrix = (jacobian.T @ weighted).tocsr().T
        return matrix, jacobian.T @ np.append(pull.ravel(), np.zeros(3 * count))

    def step(self, matrix: Any, gradient: Floats) -> Floats:
        """Return the step (N, 3) of the poses, of equations in an order with little fill."""
        step: Floats = factored(matrix, "NATURAL").solve(-gradient).reshape(-1, 3)[self.place]
        return step


def order_of(row: Integers, column: Integers) -> Integers:
    """Return an order of rows and columns with little fill, by minimum degree."""
    from scipy import sparse

    size = int(column.max(initial=-1)) + 1
    graph = sparse.csc_matrix((-np.ones(len(row)), (row, column)), shape=(size, size))
    factor = factored(graph + sparse.diags(2.0 + np.bincount(column, minlength=size), format="csc"))
    # Column j of the matrix is column perm_c[j] of the factors.
    order: Integers = np.argsort(factor.perm_c)
    return order


def factored(matrix: Any, order: str = "MMD_AT_PLUS_A") -> Any:
    """Return the factors of a symmetric positive definite matrix: a symmetric order without pivots."""
    from scipy.sparse.linalg import splu

    options = {"SymmetricMode": True}
    return splu(matrix, permc_spec=order, diag_pivot_thresh=0.0, relax=1, panel_size=_PANEL, options=options)


# Scale of Cauchy's kernel [deviations of a link].
KERNEL = 3.0
# Most iterations, the step that ends them [m, rad], and the first, least and largest damping.
_ITERATIONS, _SMALL = 50, 1e-6
_DAMPING, _LEAST, _MOST = 1e-6, 1e-9, 1e6
# Factor of falling damping after an accepted step, in general and per pose.
_RELAXED, _RELAXED_APART = 10.0, 3.0
# After a failed step, least value of rising damping, in general and per pose. It rises at links that rise in cost by
# this share of the largest rise, after a second failure by its square, and after this many failures everywhere.
_FAILED, _FAILED_APART, _RISE, _FAILS = 1e-4, 1e-2, 0.01, 3


@dataclass(frozen=True, eq=False)
class Solution:
    """Poses of a pose graph."""

    poses: Floats  # (N, 3) poses; the first one is unchanged
    links: Links  # the links with their weights
    cost: float
    iterations: int


def solve(
    poses: Floats, links: Links, *, kernel: float = KERNEL, least: float = 1e-7, settle: bool = False,
    equations: Equations | None = None,
) -> Solution:  # fmt: skip
    """Return the poses near initial ones (N, 3) that best agree with links, ignoring their weights.

    ``kernel`` is the scale of Cauchy's kernel [deviations], infinite for plain least squares; ``least`` the least
    relative gain of the cost per iteration. ``settle`` also changes motions, with damping per pose: fewer but costlier
    steps.
    """
    at, damping, fails = np.array(poses, np.float64), np.full(len(poses), _DAMPING), 0
    residual = links.residuals(at)
    squared = links.squared(residual)
    cost, count = _cost(squared, kernel), 0
    if len(at) < 2 or not len(links):
        return Solution(at, replace(links, weight=_weights(squared, kernel)), cost, 0)
    equations = equations or Equations(len(at), links.first, links.second, ordered=True)
    while count < _ITERATIONS:
        count += 1
        information = links.information * _weights(squared, kernel)[:, None, None]
        pull = np.einsum("lij,lj->li", information, residual)
        step = equations.step(*equations.at(at, information, pull, damping))
        tried = [at + step] + ([_moved_along(at, step)] if settle else [])
        tried[0][:, 2] = wrap_angle(tried[0][:, 2])
        trials = [(trial, links.residuals(trial)) for trial in tried]
        distances = [links.squared(off) for _, off in trials]
        costs = [_cost(there, kernel) for there in distances]
        best = int(np.argmin(costs))
        if not costs[best] <= cost * (1 + 1e-12):
            fails += 1
            rise = _costs(distances[best], kernel) - _costs(squared, kernel)
            some = _raised(rise, links, len(at), fails if settle else _FAILS)
            lowest = _FAILED_APART if settle else _FAILED
            damping[some] = np.minimum(10 * np.maximum(damping[some], lowest), _MOST)
            if damping.min() >= _MOST:
                break
            continue
        gain, fails = cost - costs[best], 0
        (at, residual), squared, cost = trials[best], distances[best], costs[best]
        damping = np.maximum(damping / (_RELAXED_APART if settle else _RELAXED), _LEAST)
        if np.abs(step).max() < _SMALL or gain <= least * cost:
            break
    return Solution(at, replace(links, weight=_weights(squared, kernel)), cost, count)


def _raised(rise: Floats, links: Links, count: int, fails: int) -> Flags:
    """Return the poses (N,) with rising damping after a failed step: near the largest ``rise`` (L,), later more."""
    near = np.full(count, fails >= _FAILS)
    some = rise > _RISE**fails * rise.max()
    for _ in range(2):
        near[links.first[some]] = near[links.second[some]] = True
        some = near[links.first] | near[links.second]
    return near


def _moved_along(poses: Floats, step: Floats) -> Floats:
    """Return poses (N, 3) after changing the motions from pose to pose like a step (N, 3) in the world to first order.

    The ends of a long chain turn about its beginning on circles; a step in the world leaves them.
    """
    before, after = pose_jacobians(poses, np.arange(len(poses) - 1), np.arange(1, len(poses)))
    change = np.einsum("lij,lj->li", before, step[:-1]) + np.einsum("lij,lj->li", after, step[1:])
    return chained(poses[0], pose_difference(poses[:-1], poses[1:]) + change)


def normal_equations(poses: Floats, links: Links) -> Any:
    """Return the sparse matrix (3 N - 3, 3 N - 3) of the normal equations of all poses but the first."""
    information, none = links.information * links.weight[:, None, None], np.zeros((len(links), 3))
    matrix, _ = Equations(len(poses), links.first, links.second).at(poses, information, none, np.zeros(len(poses)))
    return matrix[3:, 3:]


def pose_jacobians(poses: Floats, first: NDArray[np.int64], second: NDArray[np.int64]) -> tuple[Floats, Floats]:
    """Return the derivatives (L, 3, 3) of relative poses by the first and by the second pose."""
    c, s = np.cos(poses[first, 2]), np.sin(poses[first, 2])
    off = poses[second] - poses[first]
    x, y = c * off[:, 0] + s * off[:, 1], c * off[:, 1] - s * off[:, 0]
    zero, one = np.zeros(len(c)), np.ones(len(c))
    one_side = np.stack([-c, -s, y, s, -c, -x, zero, zero, -one], axis=1).reshape(-1, 3, 3)
    other_side = np.stack([c, s, zero, -s, c, zero, zero, zero, one], axis=1).reshape(-1, 3, 3)
    return one_side, other_side


def _weights(squared: Floats, kernel: float) -> Floats:
    weights: Floats = 1 / (1 + squared / kernel**2) if np.isfinite(kernel) else np.ones(len(squared))
    return weights


def _costs(squared: Floats, kernel: float) -> Floats:
    """Return Cauchy's kernels (L,) of squared distances."""
    costs: Floats = kernel**2 * np.log1p(squared / kernel**2) if np.isfinite(kernel) else squared
    return costs


def _cost(squared: Floats, kernel: float) -> float:
    return float(np.sum(_costs(squared, kernel)))
