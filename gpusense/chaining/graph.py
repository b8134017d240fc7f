"""Solve a pose graph by sparse least squares with a robust kernel.

The cost is the sum over links of c^2 log(1 + s / c^2), Cauchy's kernel of the squared distance s = r' I r of a link's
residual r in deviations (I is its information). Reweighted Gauss-Newton steps, damped as by Levenberg, minimise it; the
normal equations are sparse and are factored by SuperLU. Poses are relative to a fixed pose. Information may be 0 along
directions of some or all links: an undetermined direction keeps its initial value.

A step changes the poses in the world or, with ``settle``, the motions from pose to pose if that costs less. Both are
equal to first order, but the former suits a loose pose among firm ones, the latter a long chain that turns. Damping is
then per pose [1/m^2, 1/rad^2], so that a few loose poses in curved valleys of the cost do not delay all others.

The normal equations are sparse symmetric matrices of 3 x 3 blocks. Let d lead from a link's first to its second pose in
the world, and let W be its information in the world: the link adds W to the diagonal block of the second pose, T' W T
to the first pose's, and -T' W between both. T converts a small motion of the first pose to a motion of the second: the
identity with a lever -d_y, d_x of headings.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpusense._util.typing import Flags, Floats, Integers
from gpusense.chaining.links import Links, chained
from gpusense.localization.pose_algebra import compose_poses, pose_difference, wrap_angle

# Columns per panel, fewer than SuperLU's default, since few columns of a pose graph are alike.
_PANEL = 4


class Equations:
    """The normal equations of the free poses of a graph with N poses; the fixed pose has no rows and columns.

    ``ordered`` chooses an order of rows and columns with little fill; ``rows`` (N - 1,) holds the free pose of each row
    of blocks.
    """

    def __init__(self, count: int, first: Integers, second: Integers, fixed: int, *, ordered: bool = False) -> None:
        self.first, self.second = first, second
        self.rows = np.delete(np.arange(count), fixed)
        place = np.full(count, -1)
        place[self.rows] = np.arange(count - 1)
        if ordered:
            self.rows = self.rows[order_of(*self._slots(place)[:2])]
            place[self.rows] = np.arange(count - 1)
        self._row, column, self._slot = self._slots(place)
        self._starts = np.searchsorted(column, np.arange(count))
        self._diagonal = np.flatnonzero(self._row == column)

    def _slots(self, place: Integers) -> tuple[Integers, Integers, Integers]:
        """Return rows and columns of the blocks, column by column, and the number of each of the links' four blocks.

        Blocks of the fixed pose get the number after the last.
        """
        one, two, size = place[self.first], place[self.second], len(self.rows)
        row, column = np.concatenate([one, two, one, two]), np.concatenate([one, two, two, one])
        known = (row >= 0) & (column >= 0)
        # Damping needs each diagonal block, linked or not.
        key = np.concatenate([np.where(known, column * size + row, size * size), np.arange(size) * (size + 1)])
        numbers, slot = np.unique(key, return_inverse=True)
        numbers = numbers[numbers < size * size]
        return numbers % size, numbers // size, slot[: len(row)]

    def at(self, poses: Floats, information: Floats, pull: Floats, damping: float | Floats = 0.0) -> tuple[Any, Floats]:
        """Return the sparse matrix (3 N - 3, 3 N - 3) and the gradient (3 N - 3,) at (N, 3) poses.

        ``information`` (L, 3, 3) includes the links' weights, ``pull`` (L, 3) is its product with the residuals, and
        ``damping`` a number or one per free pose.
        """
        from scipy import sparse

        turned, pull, lever = _turned(poses, self.first, self.second, information, pull)
        blocks = _sums(self._slot, _blocks_of(turned, lever), len(self._row) + 1)[:, :-1]
        blocks[::4, self._diagonal] += damping
        ends = np.stack([-pull[0], -pull[1], lever[1] * pull[0] - lever[0] * pull[1] - pull[2]])
        gradient = _sums(self.first, ends, len(poses)) + _sums(self.second, pull, len(poses))
        size = 3 * len(self.rows)
        # Rows of the transposed matrix are the columns of the symmetric one.
        transposed = blocks.reshape(3, 3, -1).transpose(2, 1, 0)
        matrix = sparse.bsr_matrix((transposed, self._row, self._starts), shape=(size, size)).tocsr().T
        return matrix, gradient[:, self.rows].T.ravel()

    def step(self, matrix: Any, gradient: Floats) -> Floats:
        """Return the step (N - 1, 3) of the free poses in their order, of equations in an order with little fill."""
        step: Floats = factored(matrix, "NATURAL").solve(-gradient).reshape(-1, 3)[np.argsort(self.rows)]
        return step


def _turned(
    poses: Floats, first: Integers, second: Integers, information: Floats, pull: Floats
) -> tuple[Floats, Floats, Floats]:
    """Return, turned into the world: information (6, L) by rows, its product with residuals, and the way."""
    c, s = np.cos(poses[:, 2])[first], np.sin(poses[:, 2])[first]
    lever = (poses[second, :2] - poses[first, :2]).T
    a, b, e, d, f, h = information.reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]].T
    cc, cs, ss = c * c, c * s, s * s
    along, across, twice = a - d, cs * b, cc - ss
    world = np.stack([cc * a - 2 * across + ss * d, cs * along + twice * b, c * e - s * f,
                      ss * a + 2 * across + cc * d, s * e + c * f, h])  # fmt: skip
    x, y, turn = pull.T
    return world, np.stack([c * x - s * y, s * x + c * y, turn]), lever


def _blocks_of(world: Floats, lever: Floats) -> Floats:
    """Return the four blocks (9, 4 L) of links: of first poses, of second ones, and of both in both orders."""
    (a, b, e, d, f, h), (x, y) = world, lever
    moved = x * b - y * a + e, x * d - y * b + f, x * f - y * e + h
    turn = x * moved[1] - y * moved[0] + moved[2]
    first = a, b, moved[0], b, d, moved[1], moved[0], moved[1], turn
    second = a, b, e, b, d, f, e, f, h
    both = -np.stack([a, b, moved[0], b, d, moved[1], e, f, moved[2]])
    return np.concatenate([np.stack(first), np.stack(second), both[[0, 3, 6, 1, 4, 7, 2, 5, 8]], both], axis=1)


def _sums(number: Integers, values: Floats, count: int) -> Floats:
    """Return the sums (C, count) of the values (C, E) of each number (E,)."""
    return np.stack([np.bincount(number, row, count) for row in values])


def order_of(row: Integers, column: Integers) -> Integers:
    """Return an order of rows and columns with little fill, by minimum degree; the diagonal is among the entries."""
    from scipy import sparse

    size = int(column[-1]) + 1 if len(column) else 0
    value = np.where(row == column, np.bincount(column, minlength=size)[column] + 1.0, -1.0)
    factor = factored(sparse.csc_matrix((value, (row, column)), shape=(size, size)))
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

    poses: Floats  # (N, 3) poses; the fixed one is unchanged
    links: Links  # the links with their weights
    cost: float
    iterations: int


def solve(
    poses: Floats, links: Links, *, fixed: int = 0, kernel: float = KERNEL, least: float = 1e-7, settle: bool = False,
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
    equations = equations or Equations(len(at), links.first, links.second, fixed, ordered=True)
    while count < _ITERATIONS:
        count += 1
        information = links.information * _weights(squared, kernel)[:, None, None]
        pull = np.einsum("lij,lj->li", information, residual)
        matrix, gradient = equations.at(at, information, pull, damping[equations.rows])
        step = np.insert(equations.step(matrix, gradient), fixed, 0.0, axis=0)
        tried = [_moved(at, step)] + ([_moved_along(at, step, fixed)] if settle else [])
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
    """Return the poses (N,) with rising damping after a failed step.

    These are the poses of the links with the largest ``rise`` (L,) in cost and their neighbours, more after further
    failures.
    """
    near = np.full(count, fails >= _FAILS)
    some = rise > _RISE**fails * rise.max()
    for _ in range(2):
        near[links.first[some]] = near[links.second[some]] = True
        some = near[links.first] | near[links.second]
    return near


def _moved(poses: Floats, step: Floats) -> Floats:
    """Return poses (N, 3) after a step (N, 3) in the world."""
    result = poses + step
    result[:, 2] = wrap_angle(result[:, 2])
    return result


def _moved_along(poses: Floats, step: Floats, fixed: int) -> Floats:
    """Return poses (N, 3) after changing the motions from pose to pose like a step (N, 3) in the world to first order.

    The ends of a long chain turn about its beginning on circles; a step in the world leaves them.
    """
    before, after = pose_jacobians(poses, np.arange(len(poses) - 1), np.arange(1, len(poses)))
    change = np.einsum("lij,lj->li", before, step[:-1]) + np.einsum("lij,lj->li", after, step[1:])
    result = chained(poses[0], pose_difference(poses[:-1], poses[1:]) + change)
    return compose_poses(poses[fixed], pose_difference(result[fixed], result)) if fixed else result


def normal_equations(poses: Floats, links: Links, weight: Floats, fixed: int) -> tuple[Any, Floats]:
    """Return the sparse matrix of the normal equations of the free poses, in their order, and the gradient."""
    information = links.information * weight[:, None, None]
    pull = np.einsum("lij,lj->li", information, links.residuals(poses))
    return Equations(len(poses), links.first, links.second, fixed).at(poses, information, pull)


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
    """Return Cauchy's weights of links by their squared distances."""
    weights: Floats = 1 / (1 + squared / kernel**2) if np.isfinite(kernel) else np.ones(len(squared))
    return weights


def _costs(squared: Floats, kernel: float) -> Floats:
    """Return Cauchy's kernels (L,) of squared distances."""
    costs: Floats = kernel**2 * np.log1p(squared / kernel**2) if np.isfinite(kernel) else squared
    return costs


def _cost(squared: Floats, kernel: float) -> float:
    """Return the sum of Cauchy's kernels."""
    return float(np.sum(_costs(squared, kernel)))
