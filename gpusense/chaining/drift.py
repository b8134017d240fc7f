"""Compute covariances in a solved pose graph: of relative poses (the drift between scans), and of all poses.

Covariances of all poses are diagonal blocks of the inverse of the sparse normal equations. The matrix of 3 x 3 blocks
is eliminated front by front along the elimination tree (Duff and Reid 1983), successive columns with equal rows at
once. The blocks of the inverse within each front follow from its parent's blocks, from the root down (Takahashi et al.
1973): for L the columns below pivots D, and Z the inverse, Z_sj = -Z_ss L and Z_jj = D^-1 + L' Z_ss L. Only these
blocks are computed: time and memory equal the elimination's.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gpusense._util.typing import Floats, Integers
from gpusense.chaining.graph import Solution, normal_equations, order_of, pose_jacobians
from gpusense.chaining.links import CLOSURE, Links

# Most poses with a kept joint covariance; in a longer graph each represents the poses up to the next. Largest share of
# sides of loose steps, to represent breaks of the chain, and their variance in multiples of the usual one.
_ANCHORS, _BREAKS, _LOOSE = 300, 0.4, 10.0
# Length that converts heading to position variance [m].
_LEVER = 3.0
# Poses per stretch that is eliminated at once.
_STRETCH = 16
# Damping [1/m^2, 1/rad^2]; its inverse is the variance along a direction that no link observes.
DAMPING = 1e-6


class Drift:
    """Covariances of relative poses of a solved pose graph.

    In a larger graph, all other poses are eliminated from the local links. Closures become links between kept poses,
    widened by the covariance of the steps in between; the time is linear in the number of poses for any number of
    closures.

    At most ``most`` poses are kept; any other pose takes the covariance of the last kept pose before it.
    """

    def __init__(self, solution: Solution, most: int = _ANCHORS) -> None:
        poses, links, count = solution.poses, solution.links, len(solution.poses)
        self._poses = poses
        spread = _spread_of_steps(solution) if count > 1 else np.zeros((0, 3, 3))
        self.anchors = anchors = _anchors_of(spread, most) if count > most else np.arange(count)
        self._joint = np.zeros((len(anchors), 3, len(anchors), 3))
        if count < 2:
            return
        moved = (links.kind == CLOSURE) & (len(anchors) < count)
        local = links[~moved]
        matrix = normal_equations(poses, local)
        # The first pose is known, so its rows and columns are 0.
        whole, shape = np.zeros_like(self._joint), (len(anchors) - 1, 3, len(anchors) - 1, 3)
        whole[1:, :, 1:, :] = _reduced(matrix, anchors[1:] - 1).reshape(shape)
        if moved.any():
            _add_closures(whole, poses, links[moved], anchors, spread)
        inverse = np.linalg.inv(whole[1:, :, 1:, :].reshape(3 * shape[0], 3 * shape[0]))
        self._joint[1:, :, 1:, :] = (0.5 * (inverse + inverse.T)).reshape(shape)

    def relative(self, first: Integers, second: Integers) -> Floats:
        """Return the covariances (L, 3, 3) of the poses of second scans in the frames of first ones."""
        a, b = (np.searchsorted(self.anchors, scans, "right") - 1 for scans in (first, second))
        one, two = pose_jacobians(self._poses, self.anchors[a], self.anchors[b])
        side = one @ self._joint[a, :, b, :] @ two.transpose(0, 2, 1)
        total = one @ self._joint[a, :, a, :] @ one.transpose(0, 2, 1)
        total += two @ self._joint[b, :, b, :] @ two.transpose(0, 2, 1)
        result: Floats = total + side + side.transpose(0, 2, 1)
        return result


def _spread_of_steps(solution: Solution) -> Floats:
    """Return the covariances (N - 1, 3, 3) of the poses relative to their predecessors, by the links between both."""
    links = solution.links
    information = np.zeros((len(solution.poses), 3, 3))
    follow = np.abs(links.second - links.first) == 1
    later = np.maximum(links.first, links.second)[follow]
    np.add.at(information, later, links.information[follow] * links.weight[follow, None, None])
    spread: Floats = np.asarray(np.linalg.inv(information[1:] + DAMPING * np.eye(3)), np.float64)
    return spread


def _anchors_of(spread: Floats, most: int) -> Integers:
    """Return the poses to keep: evenly spaced ones, and both sides of the loosest steps."""
    count = len(spread) + 1
    variance = spread[:, 0, 0] + spread[:, 1, 1] + _LEVER**2 * spread[:, 2, 2]
    loose = np.flatnonzero(variance > _LOOSE * np.median(variance))
    loose = loose[np.argsort(-variance[loose], kind="stable")][: int(_BREAKS * most / 2)]
    even = np.arange(0, count, -(-count // (most - 2 * len(loose))))
    anchors: Integers = np.unique(np.concatenate([even, loose, loose + 1]))
    return anchors


def _reduced(matrix: Any, kept: Integers) -> Floats:
    """Eliminate all poses except ``kept``, which ascend, from sparse information; return the information of ``kept``.

    Links join nearby poses of the chain, so each round eliminates every second stretch of the remaining poses. Poses
    with a link to a farther stretch are eliminated last.
    """
    blocks = _blocks_of(matrix)
    count = blocks.shape[0] // 3
    inner, stretch = np.setdiff1d(np.arange(count), kept), np.arange(count) // _STRETCH + 1
    row, column = blocks.indices, np.repeat(np.arange(count), np.diff(blocks.indptr))
    # The lowest set bit of a stretch's number.
    rank = stretch & -stretch
    rank[row[np.abs(stretch[row] - stretch[column]) > 1]] = count
    order = np.append(inner[np.lexsort((inner, rank[inner]))], kept)
    parts, parent = _parts_of(blocks, order, len(inner))
    _, updates = _eliminated(blocks, order, parts, parent, DAMPING)
    rows = _scalars(np.arange(count), kept)
    left: Floats = matrix[rows][:, rows].toarray() + DAMPING * np.eye(len(rows))
    for below, update in updates:
        at = _scalars(np.arange(len(inner), count), below)
        left[at[:, None], at] += update
    return left


def _add_closures(whole: Floats, poses: Floats, closures: Links, anchors: Integers, spread: Floats) -> None:
    """Add closures to the information (A, 3, A, 3) of kept poses.

    Small motions are expressed as motions of a frame at the origin fixed to the scan, so that a link has the same
    information between any scans of a rigid body. The closure's covariance is widened by the steps from the kept poses
    to the scans, as if these had no further links.
    """
    steps = np.arange(len(spread))
    _, two = pose_jacobians(poses, steps, steps + 1)
    back = np.linalg.inv(two @ _fixed(poses[1:]))
    step = back @ spread @ back.transpose(0, 2, 1)
    way = np.zeros((len(poses), 3, 3))
    length = np.diff(np.append(anchors, len(poses)))
    for k in range(1, int(length.max())):
        at = anchors[length > k] + k
        way[at] = way[at - 1] + step[at - 1]
    first, second = closures.first, closures.second
    _, two = pose_jacobians(poses, first, second)
    two = two @ _fixed(poses[second])
    information = two.transpose(0, 2, 1) @ (closures.information * closures.weight[:, None, None]) @ two
    information = information @ np.linalg.inv(np.eye(3) + (way[first] + way[second]) @ information)
    blocks = whole.transpose(0, 2, 1, 3)
    ends = [np.searchsorted(anchors, scans, "right") - 1 for scans in (first, second)]
    moved = [np.linalg.inv(_fixed(poses[anchors[end]])) for end in ends]
    for one, a in enumerate(ends):
        for other, b in enumerate(ends):
            block = moved[one].transpose(0, 2, 1) @ information @ moved[other]
            np.add.at(blocks, (a, b), block if one == other else -block)


def _fixed(poses: Floats) -> Floats:
    """Return the derivatives (L, 3, 3) of poses by the motion of their frame at the origin."""
    result = np.tile(np.eye(3), (len(poses), 1, 1))
    result[:, 0, 2], result[:, 1, 2] = -poses[:, 1], poses[:, 0]
    return result


def pose_covariances(solution: Solution) -> Floats:
    """Return the covariances (N, 3, 3) of poses, given the first one; about 1e6 where no link observes a direction."""
    count = len(solution.poses)
    result = np.zeros((count, 3, 3))
    if count > 1:
        result[1:] = inverse_blocks(normal_equations(solution.poses, solution.links), DAMPING)
    return result


def inverse_blocks(matrix: Any, damping: float) -> Floats:
    """Return the diagonal blocks (N, 3, 3) of the inverse of a sparse positive definite matrix plus damping."""
    blocks = _blocks_of(matrix)
    count = blocks.shape[0] // 3
    order = order_of(blocks.indices, np.repeat(np.arange(count), np.diff(blocks.indptr)))
    parts, parent = _parts_of(blocks, order, count)
    factors, _ = _eliminated(blocks, order, parts, parent, damping)
    result, fronts = np.empty((count, 3, 3)), dict[int, tuple[Integers, Floats]]()
    waiting = np.bincount(parent[parent >= 0], minlength=len(parts))
    for k in range(len(parts) - 1, -1, -1):
        (begin, end, below), (inverse, factor), size = parts[k], factors[k], 3 * (parts[k][1] - parts[k][0])
        front = np.empty((size + 3 * len(below),) * 2)
        front[:size, :size] = inverse
        if len(below):
            rows, whole = fronts[parent[k]]
            at = _scalars(rows, below)
            inner = whole[at[:, None], at]
            across = -inner @ factor
            front[size:, size:], front[size:, :size], front[:size, size:] = inner, across, across.T
            front[:size, :size] -= factor.T @ across
            waiting[parent[k]] -= 1
            if not waiting[parent[k]]:
                del fronts[parent[k]]
        if waiting[k]:
            fronts[k] = np.append(np.arange(begin, end), below), front
        pivots = np.arange(end - begin)
        result[order[begin:end]] = front[:size, :size].reshape(end - begin, 3, end - begin, 3)[pivots, :, pivots]
    return 0.5 * (result + result.transpose(0, 2, 1))


def _blocks_of(matrix: Any) -> Any:
    """Return a sparse matrix in sorted 3 x 3 blocks."""
    blocks = matrix.tobsr((3, 3))
    blocks.sort_indices()
    return blocks


def _parts_of(blocks: Any, order: Integers, count: int) -> tuple[list[tuple[int, int, Integers]], Integers]:
    """Return runs of the first ``count`` elimination steps: first step, end, and common rows below; and their parents.

    The parent is the part of the first row below; -1 without one among these steps.
    """
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    places, starts = place[blocks.indices].tolist(), blocks.indptr.tolist()
    below: list[list[int]] = []
    children: list[list[list[int]]] = [[] for _ in range(count)]
    for k, step in enumerate(order[:count].tolist()):
        rows = sorted({row for row in places[starts[step] : starts[step + 1]] if row > k}.union(*children[k]))
        children[k] = []
        if rows and rows[0] < count:
            children[rows[0]].append(rows[1:])
        below.append(rows)
    parts, begin = [], 0
    for k in range(count):
        rows = below[k]
        if k + 1 == count or not len(rows) or rows[0] != k + 1 or len(rows) != len(below[k + 1]) + 1:
            parts.append((begin, k + 1, np.array(rows, np.int64)))
            begin = k + 1
    home = np.repeat(np.arange(len(parts)), [end - begin for begin, end, _ in parts])
    return parts, np.array([home[below[0]] if len(below) and below[0] < count else -1 for _, _, below in parts])


def _eliminated(
    blocks: Any, order: Integers, parts: list[tuple[int, int, Integers]], parent: Integers, damping: float
) -> tuple[list[tuple[Floats, Floats]], list[tuple[Integers, Floats]]]:
    """Return the inverse pivots and the factor L of each part, and the changes of rows that are no part."""
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    places, starts = place[blocks.indices], blocks.indptr
    factors, updates = [], dict[int, list[tuple[Integers, Floats]]]()
    for k, (begin, end, below) in enumerate(parts):
        rows, size = np.append(np.arange(begin, end), below), 3 * (end - begin)
        split = np.zeros((len(rows), 3, len(rows), 3))
        for column, step in enumerate(order[begin:end].tolist()):
            entries = slice(starts[step], starts[step + 1])
            later = places[entries] >= begin + column
            at = np.searchsorted(rows, places[entries][later])
            split[at, :, column] = blocks.data[entries][later].transpose(0, 2, 1)
        front = split.reshape(3 * len(rows), -1)
        for child, update in updates.pop(k, ()):
            at = _scalars(rows, child)
            front[at[:, None], at] += update
        # Only the lower triangle of the pivots is used.
        pivot, side = np.tril(front[:size, :size]), front[size:, :size]
        inverse = np.asarray(np.linalg.inv(pivot + np.tril(pivot, -1).T + damping * np.eye(size)), np.float64)
        factor: Floats = side @ inverse
        factors.append((inverse, factor))
        if len(below):
            updates.setdefault(int(parent[k]), []).append((below, front[size:, size:] - factor @ side.T))
    return factors, updates.pop(-1, [])


def _scalars(rows: Integers, some: Integers) -> Integers:
    """Return the places (3 R,) of the scalar rows of some (R,) ascending block rows."""
    return (3 * np.searchsorted(rows, some)[:, None] + np.arange(3)).ravel()
