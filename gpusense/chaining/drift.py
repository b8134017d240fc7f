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

from gpusense._util.typing import Flags, Floats, Integers
from gpusense.chaining.graph import Solution, normal_equations, order_of, pose_jacobians
from gpusense.chaining.links import CLOSURE, Links

# Most poses with a kept joint covariance; in a longer graph each represents the poses up to the next. Largest share of
# sides of loose steps, to represent breaks of the chain, and their variance in multiples of the usual one.
_ANCHORS, _BREAKS, _LOOSE = 300, 0.4, 10.0
# Length that converts heading to position variance [m].
_LEVER = 3.0
# Poses per eliminated stretch, and stretches joined for the next elimination.
_STRETCH, _JOINED = 32, 16
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
        rows = (3 * (anchors[1:, None] - 1) + np.arange(3)).ravel()
        whole, shape = np.zeros_like(self._joint), (len(anchors) - 1, 3, len(anchors) - 1, 3)
        whole[1:, :, 1:, :] = _reduced(matrix, rows).reshape(shape)
        if moved.any():
            _add_closures(whole, poses, links[moved], anchors, spread)
        inverse = np.linalg.inv(whole[1:, :, 1:, :].reshape(len(rows), len(rows)))
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


def _reduced(matrix: Any, rows: Integers) -> Floats:
    """Eliminate all but some rows of sparse information, by Schur's complement, and return the information of these.

    Links join nearby poses of the chain. Stretches are therefore eliminated as dense matrices, except poses with links
    to a later stretch; longer stretches of the rest follow.
    """
    from scipy import sparse

    if not len(rows):
        return np.zeros((0, 0))
    kept = np.zeros(matrix.shape[0], bool)
    kept[rows] = True
    stretch = np.arange(len(kept)) // (3 * _STRETCH)
    left = (matrix + DAMPING * sparse.identity(len(kept), format="csc")).tocsr()
    while not kept.all():
        left, inner = _without_stretches(left, kept, stretch)
        kept, stretch = kept[~inner], stretch[~inner] // _JOINED
    result: Floats = left.toarray()
    return result


def _without_stretches(matrix: Any, kept: Flags, stretch: Integers) -> tuple[Any, Flags]:
    """Eliminate rows of sparse information that link later stretches only at kept rows.

    ``stretch`` (M,) numbers the stretches of the rows in ascending order. Returns the information of all other rows,
    and whether each row (M,) was eliminated.
    """
    from scipy import sparse

    entries, count = matrix.tocoo(), len(kept)
    row, column, value = entries.row, entries.col, entries.data
    inner = ~kept
    inner[row[inner[row] & inner[column] & (stretch[row] < stretch[column])]] = False
    members = np.flatnonzero(inner)
    parts, part = np.unique(stretch[members], return_inverse=True)
    place, of = np.zeros((2, count), np.int64)
    of[members], place[members] = part, _ranks(part)
    size = int(place.max(initial=-1)) + 1
    # Missing rows of short stretches are rows of an identity.
    pivots = np.tile(np.eye(size), (len(parts), 1, 1))
    some = inner[row] & inner[column]
    pivots[of[row[some]], place[row[some]], place[column[some]]] = value[some]
    some = inner[row] & ~inner[column]
    ends, end = np.unique(of[row[some]] * count + column[some], return_inverse=True)
    rank = _ranks(ends // count)
    sides = np.zeros((len(parts), size, int(rank.max(initial=-1)) + 1))
    sides[of[row[some]], place[row[some]], rank[end]] = value[some]
    numbers = np.full((len(parts), sides.shape[2]), -1)
    numbers[ends // count, rank] = ends % count
    change = -sides.transpose(0, 2, 1) @ np.linalg.solve(pivots, sides)
    one, two = np.broadcast_to(numbers[:, :, None], change.shape), np.broadcast_to(numbers[:, None, :], change.shape)
    real = (one >= 0) & (two >= 0)
    some = ~inner[row] & ~inner[column]
    # Entries of the same place are added.
    triples = zip((value[some], row[some], column[some]), (change[real], one[real], two[real]), strict=True)
    values, rows, columns = (np.concatenate(pair) for pair in triples)
    number = np.cumsum(~inner) - 1
    left = int(np.count_nonzero(~inner))
    return sparse.csr_matrix((values, (number[rows], number[columns])), shape=(left, left)), inner


def _ranks(groups: Integers) -> Integers:
    """Return the rank (M,) of each element in its group, for ascending numbers of groups (M,)."""
    ranks: Integers = np.arange(len(groups)) - np.searchsorted(groups, groups)
    return ranks


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
    blocks = matrix.tobsr((3, 3))
    blocks.sort_indices()
    count = blocks.shape[0] // 3
    order = order_of(blocks.indices, np.repeat(np.arange(count), np.diff(blocks.indptr)))
    parts = _parts_of(blocks, order)
    home = np.repeat(np.arange(len(parts)), [end - begin for begin, end, _ in parts])
    # Part of the first row below each part; -1 for a root.
    parent = np.array([home[below[0]] if len(below) else -1 for _, _, below in parts])
    factors = _eliminated(blocks, order, parts, parent, damping)
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


def _parts_of(blocks: Any, order: Integers) -> list[tuple[int, int, Integers]]:
    """Return runs of elimination steps, each with its first step, its end, and the common rows below."""
    count = len(order)
    place = np.empty(count, np.int64)
    place[order] = np.arange(count)
    places, starts = place[blocks.indices].tolist(), blocks.indptr.tolist()
    below: list[list[int]] = []
    children: list[list[list[int]]] = [[] for _ in range(count)]
    for k, step in enumerate(order.tolist()):
        rows = sorted({row for row in places[starts[step] : starts[step + 1]] if row > k}.union(*children[k]))
        children[k] = []
        if rows:
            children[rows[0]].append(rows[1:])
        below.append(rows)
    parts, begin = [], 0
    for k in range(count):
        rows = below[k]
        if k + 1 == count or not len(rows) or rows[0] != k + 1 or len(rows) != len(below[k + 1]) + 1:
            parts.append((begin, k + 1, np.array(rows, np.int64)))
            begin = k + 1
    return parts


def _eliminated(
    blocks: Any, order: Integers, parts: list[tuple[int, int, Integers]], parent: Integers, damping: float
) -> list[tuple[Floats, Floats]]:
    """Return the inverse pivots and the factor L of each part."""
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
    return factors


def _scalars(rows: Integers, some: Integers) -> Integers:
    """Return the places (3 R,) of the scalar rows of some (R,) ascending block rows."""
    return (3 * np.searchsorted(rows, some)[:, None] + np.arange(3)).ravel()
