"""Covariances of all poses of a pose graph: the diagonal blocks of the inverse of its sparse normal equations.

The matrix of 3 x 3 blocks is eliminated front by front along the elimination tree (Duff and Reid 1983), successive
columns with equal rows at once. From its root down, the blocks of the inverse within each front follow from those of
its parent (Takahashi et al. 1973): with L the columns below pivots D, and Z the inverse, Z_sj = -Z_ss L and Z_jj = D^-1
+ L' Z_ss L. No further blocks are computed, so time and memory are those of the elimination.
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
    parts = _parts_of(blocks, order)
    home = np.repeat(np.arange(len(parts)), [end - begin for begin, end, _ in parts])
    factors, inverses = _eliminated(blocks, order, parts, home, damping)
    children = np.bincount([home[rows[0]] for _, _, rows in parts if len(rows)], minlength=len(parts))
    fronts: dict[int, Floats] = {}
    result = np.empty((count, 3, 3))
    for k in range(len(parts) - 1, -1, -1):
        begin, end, rows = parts[k]
        factor, size = factors[k], 3 * (end - begin)
        front = np.empty((size + 3 * len(rows), size + 3 * len(rows)))
        front[:size, :size] = inverses[k]
        if len(rows):
            parent = int(home[rows[0]])
            first, last, known = parts[parent]
            at = _scalars(np.searchsorted(np.append(np.arange(first, last), known), rows))
            inner = fronts[parent][np.ix_(at, at)]
            side = -inner @ factor
            front[size:, size:], front[size:, :size], front[:size, size:] = inner, side, side.T
            front[:size, :size] -= factor.T @ side
            children[parent] -= 1
            if not children[parent]:
                del fronts[parent]
        pivots = np.arange(end - begin)
        found = front[:size, :size].reshape(end - begin, 3, end - begin, 3)[pivots, :, pivots, :]
        result[order[begin:end]] = 0.5 * (found + found.transpose(0, 2, 1))
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


def _parts_of(blocks: Any, order: Integers) -> list[tuple[int, int, Integers]]:
    """Return runs of steps of the elimination, each with its first and its end, and the rows below that all share."""
    count = len(order)
    place = np.empty(count, np.int64)
    place[order] = np.arange(count)
    below: list[Integers] = []
    children: list[list[Integers]] = [[] for _ in range(count)]
    for k in range(count):
        columns = place[blocks.indices[blocks.indptr[order[k]] : blocks.indptr[order[k] + 1]]]
        rows = np.unique(np.concatenate([columns[columns > k], *children[k]]))
        children[k] = []
        if len(rows):
            children[rows[0]].append(rows[1:])
        below.append(rows)
    parts, begin = [], 0
    for k in range(count):
        rows = below[k]
        if k + 1 == count or not len(rows) or rows[0] != k + 1 or len(rows) != len(below[k + 1]) + 1:
            parts.append((begin, k + 1, rows))
            begin = k + 1
    return parts


def _eliminated(
    blocks: Any, order: Integers, parts: list[tuple[int, int, Integers]], home: Integers, damping: float
) -> tuple[list[Floats], list[Floats]]:
    """Return for each run of steps of the elimination the factor L and the inverse of the pivots.

    ``home`` (N,) has the run of each step.
    """
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    factors: list[Floats] = []
    inverses: list[Floats] = []
    waiting: list[list[tuple[Integers, Floats]]] = [[] for _ in parts]
    for k, (begin, end, below) in enumerate(parts):
        rows, size = np.append(np.arange(begin, end), below), 3 * (end - begin)
        front = np.zeros((3 * len(rows), 3 * len(rows)))
        # Columns of the pivots; only the lower triangle of the pivots is used.
        split = front.reshape(len(rows), 3, len(rows), 3)
        for step in range(begin, end):
            part = slice(blocks.indptr[order[step]], blocks.indptr[order[step] + 1])
            columns, values = place[blocks.indices[part]], blocks.data[part]
            later = columns >= step
            split[np.searchsorted(rows, columns[later]), :, step - begin, :] += values[later].transpose(0, 2, 1)
        for others, update in waiting[k]:
            at = _scalars(np.searchsorted(rows, others))
            front[np.ix_(at, at)] += update
        waiting[k] = []
        pivot = np.tril(front[:size, :size])
        pivot += np.tril(pivot, -1).T + damping * np.eye(size)
        inverse: Floats = np.asarray(np.linalg.inv(pivot), np.float64)
        side = front[size:, :size]
        factor: Floats = side @ inverse
        if len(below):
            waiting[home[below[0]]].append((below, front[size:, size:] - factor @ side.T))
        factors.append(factor)
        inverses.append(inverse)
    return factors, inverses


def _scalars(blocks: Integers) -> Integers:
    """Return the scalar rows of blocks of three."""
    rows: Integers = (3 * blocks[:, None] + np.arange(3)).ravel()
    return rows
