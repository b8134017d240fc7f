"""Covariances of all poses of a pose graph: the diagonal blocks of the inverse of its sparse normal equations.

The matrix of 3 x 3 blocks is eliminated front by front along the elimination tree (Duff and Reid 1983). From its root
down, the blocks of the inverse within each front follow from those of its parent (Takahashi et al. 1973): with L the
column below a pivot D, and Z the inverse, Z_sj = -Z_ss L and Z_jj = D^-1 + L' Z_ss L. No further blocks are computed,
so time and memory are those of the elimination.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpusense.chaining.drift import DAMPING
from gpusense.chaining.graph import Solution, normal_equations

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


def pose_covariances(solution: Solution) -> Floats:
    """Return the covariances (N, 3, 3) of poses, given the first one.

    A direction that no link observes has a variance of about 1e6 m^2 or rad^2.
    """
    count = len(solution.poses)
    result = np.zeros((count, 3, 3))
    if count > 1:
        matrix, _ = normal_equations(solution.poses, solution.links, solution.links.weight, 0)
        result[1:] = inverse_blocks(matrix, DAMPING)
    return result


def inverse_blocks(matrix: Any, damping: float) -> Floats:
    """Return the diagonal blocks (N, 3, 3) of the inverse of a sparse symmetric positive definite matrix.

    Args:
        matrix: (3 N, 3 N) sparse.
        damping: Added to its diagonal.
    """
    blocks = matrix.tobsr((3, 3))
    blocks.sort_indices()
    count = blocks.shape[0] // 3
    order = _order(blocks, count)
    place = np.empty(count, np.int64)
    place[order] = np.arange(count)
    below, factors, inverses = _eliminated(blocks, order, place, damping)
    children = [0] * count
    for rows in below:
        if len(rows):
            children[rows[0]] += 1
    fronts: dict[int, Floats] = {}
    result = np.empty((count, 3, 3))
    for k in range(count - 1, -1, -1):
        rows, factor = below[k], factors[k]
        size = 3 * len(rows)
        front = np.empty((3 + size, 3 + size))
        if size:
            parent = int(rows[0])
            known = np.append(parent, below[parent])
            at = _scalars(np.searchsorted(known, rows))
            inner = fronts[parent][np.ix_(at, at)]
            side = -inner @ factor
            front[3:, 3:], front[3:, :3], front[:3, 3:] = inner, side, side.T
            front[:3, :3] = inverses[k] - factor.T @ side
            children[parent] -= 1
            if not children[parent]:
                del fronts[parent]
        else:
            front[:3, :3] = inverses[k]
        result[order[k]] = 0.5 * (front[:3, :3] + front[:3, :3].T)
        if children[k]:
            fronts[k] = front
    return result


def _order(blocks: Any, count: int) -> Integers:
    """Return an elimination order of the blocks with little fill: minimum degree, by SuperLU."""
    from scipy import sparse
    from scipy.sparse.linalg import splu

    pattern = sparse.csr_matrix((np.ones(len(blocks.indices)), blocks.indices, blocks.indptr), shape=(count, count))
    dominant = (-pattern + sparse.diags(np.asarray(pattern.sum(axis=1)).ravel() + 2.0)).tocsc()
    factor = splu(dominant, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    # Column j of the matrix is column perm_c[j] of the factors.
    order: Integers = np.argsort(factor.perm_c)
    return order


def _eliminated(
    blocks: Any, order: Integers, place: Integers, damping: float
) -> tuple[list[Integers], list[Floats], list[Floats]]:
    """Return for each step of the elimination the rows below, the factor L, and the inverse of the pivot."""
    count = len(order)
    below: list[Integers] = []
    factors: list[Floats] = []
    inverses: list[Floats] = []
    waiting: list[list[tuple[Integers, Floats]]] = [[] for _ in range(count)]
    for k in range(count):
        node = order[k]
        part = slice(blocks.indptr[node], blocks.indptr[node + 1])
        columns, values = place[blocks.indices[part]], blocks.data[part]
        later = columns >= k
        columns, values = columns[later], values[later]
        rows = np.unique(np.concatenate([np.array([k]), columns, *(rows for rows, _ in waiting[k])]))
        front = np.zeros((3 * len(rows), 3 * len(rows)))
        for at, value in zip(np.searchsorted(rows, columns), values, strict=True):
            # Row block of the pivot; only the front below it is used further.
            front[3 * at : 3 * at + 3, :3] += value.T
        front[:3, :3] += damping * np.eye(3)
        for others, update in waiting[k]:
            at = _scalars(np.searchsorted(rows, others))
            front[np.ix_(at, at)] += update
        waiting[k] = []
        inverse: Floats = np.asarray(np.linalg.inv(front[:3, :3]), np.float64)
        side = front[3:, :3]
        factor: Floats = side @ inverse
        if len(rows) > 1:
            waiting[rows[1]].append((rows[1:], front[3:, 3:] - factor @ side.T))
        below.append(rows[1:])
        factors.append(factor)
        inverses.append(inverse)
    return below, factors, inverses


def _scalars(blocks: Integers) -> Integers:
    """Return the scalar rows of blocks of three."""
    rows: Integers = (3 * blocks[:, None] + np.arange(3)).ravel()
    return rows
