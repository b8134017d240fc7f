"""Compute covariances of all poses of a pose graph: diagonal blocks of the inverse of its sparse normal equations.

The matrix of 3 x 3 blocks is eliminated front by front along the elimination tree (Duff and Reid 1983): successive
columns with equal rows at once, and fronts of equal shape with finished children together. The blocks of the inverse
within each front follow from its parent's blocks, from the root down (Takahashi et al. 1973): for L the columns below
pivots D, and Z the inverse, Z_sj = -Z_ss L and Z_jj = D^-1 + L' Z_ss L. Only these blocks are computed: time and memory
equal the elimination's.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gpusense._util.typing import Floats, Integers
from gpusense.chaining.drift import DAMPING
from gpusense.chaining.graph import Solution, normal_equations, order_of


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
    """Return the diagonal blocks (N, 3, 3) of the inverse of a sparse positive definite matrix plus damping."""
    blocks = matrix.tobsr((3, 3))
    blocks.sort_indices()
    count = blocks.shape[0] // 3
    order = order_of(blocks.indices, np.repeat(np.arange(count), np.diff(blocks.indptr)))
    tree = Tree(_parts_of(blocks, order), len(order))
    factors, inverses = _eliminated(blocks, order, tree, damping)
    fronts: dict[int, Floats] = {}
    result = np.empty((len(order), 3, 3))
    for k in range(len(tree.groups) - 1, -1, -1):
        which = tree.groups[k]
        size, factor = 3 * int(tree.size[which[0]]), factors[k]
        side = 3 * int(tree.below[which[0]])
        front = np.empty((len(which), size + side, size + side))
        front[:, :size, :size] = inverses[k]
        if side:
            inner = front[:, size:, size:]
            for group, some, at in tree.parents(which):
                place = tree.number[tree.parent[which[some]]]
                inner[some] = fronts[group][place[:, None, None], at[:, :, None], at[:, None, :]]
            across = -inner @ factor
            front[:, size:, :size], front[:, :size, size:] = across, across.transpose(0, 2, 1)
            front[:, :size, :size] -= factor.transpose(0, 2, 1) @ across
        pivots = np.arange(size // 3)
        found = front[:, :size, :size].reshape(len(which), size // 3, 3, size // 3, 3)[:, pivots, :, pivots, :]
        result[order[tree.begin[which] + pivots[:, None]]] = 0.5 * (found + found.transpose(0, 1, 3, 2))
        fronts[k] = front
        for group in tree.last_used[k]:
            del fronts[group]
    return result


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


class Tree:
    """Elimination tree of parts; parts of equal shape with finished children are eliminated as a group.

    A part is its first and end step, and its common rows below; the matrix has ``count`` = N steps.
    """

    def __init__(self, parts: list[tuple[int, int, Integers]], count: int) -> None:
        self.begin = np.array([begin for begin, _, _ in parts])  # (P,) first step of each part
        self.size = np.array([end - begin for begin, end, _ in parts])  # (P,) number of its steps
        self.below = np.array([len(rows) for _, _, rows in parts])  # (P,) number of its rows below
        self.home = np.repeat(np.arange(len(parts)), self.size)  # (N,) part of each step
        self._start = np.append(0, np.cumsum(self.below))
        rows = np.concatenate([rows for _, _, rows in parts]).astype(np.int64)
        self._count, self._keys = count, np.repeat(np.arange(len(parts)), self.below) * count + rows
        self.parent = np.full(len(parts), -1)  # (P,) part of the first row below; -1 for a root
        inner = self.below > 0
        self.parent[inner] = self.home[rows[self._start[:-1][inner]]]
        self._at = self.place(np.repeat(self.parent, self.below), rows)
        level = np.zeros(len(parts), np.int64)
        for part, parent in enumerate(self.parent.tolist()):
            if parent >= 0:
                level[parent] = max(level[parent], level[part] + 1)
        shape = np.stack([self.below, self.size, level])
        order = np.lexsort(shape)
        ends = np.flatnonzero((np.diff(shape[:, order], axis=1) != 0).any(axis=0)) + 1
        self.groups = np.split(order, ends)  # parts of each group, children first
        self.number, self._group = np.empty(len(parts), np.int64), np.empty(len(parts), np.int64)
        for group, which in enumerate(self.groups):
            self.number[which], self._group[which] = np.arange(len(which)), group
        first = np.arange(len(self.groups))
        np.minimum.at(first, self._group[self.parent[inner]], self._group[inner])
        # For each group, the groups needed only by it and by later groups on the way up.
        self.last_used = [np.flatnonzero(first == group).tolist() for group in range(len(first))]

    def place(self, part: Integers, row: Integers) -> Integers:
        """Return the positions of rows in the fronts of parts: the part's steps, then the rows below."""
        within = np.searchsorted(self._keys, part * self._count + row) - self._start[part] + self.size[part]
        step = row - self.begin[part]
        places: Integers = np.where(step < self.size[part], step, within)
        return places

    def parents(self, which: Integers) -> list[tuple[int, Integers, Integers]]:
        """Return, for each group of parents of a group's parts, its number, its parts' children, and their positions.

        Places (C, R) locate the scalar rows below in the fronts of the parents.
        """
        rows = self._at[self._start[which][:, None] + np.arange(self.below[which[0]])]
        group = self._group[self.parent[which]]
        chosen = [(one, np.flatnonzero(group == one)) for one in np.unique(group).tolist()]
        return [(one, some, (3 * rows[some][:, :, None] + np.arange(3)).reshape(len(some), -1)) for one, some in chosen]


def _eliminated(blocks: Any, order: Integers, tree: Tree, damping: float) -> tuple[list[Floats], list[Floats]]:
    """Return the factors L and inverse pivots of the parts, for each group of the tree."""
    place = np.empty(len(order), np.int64)
    place[order] = np.arange(len(order))
    step, row = place[np.repeat(np.arange(len(order)), np.diff(blocks.indptr))], place[blocks.indices]
    # Columns of the pivots; only the lower triangle of the pivots is used.
    entry = np.flatnonzero(row >= step)
    entry = entry[np.argsort(tree.home[step[entry]], kind="stable")]
    part = tree.home[step[entry]]
    start, at = np.searchsorted(part, np.arange(len(tree.size) + 1)), tree.place(part, row[entry])
    factors: list[Floats] = []
    inverses: list[Floats] = []
    waiting: list[list[tuple[Integers, Integers, Floats]]] = [[] for _ in tree.groups]
    for k, which in enumerate(tree.groups):
        size, below = int(tree.size[which[0]]), int(tree.below[which[0]])
        split = np.zeros((len(which), size + below, 3, size + below, 3))
        each = (start[1:] - start[:-1])[which]
        one = np.repeat(np.arange(len(which)), each)
        some = np.arange(len(one)) + np.repeat(start[which] - np.cumsum(each) + each, each)
        column = step[entry[some]] - tree.begin[which[one]]
        split[one, at[some], :, column, :] = blocks.data[entry[some]].transpose(0, 2, 1)
        front = split.reshape(len(which), 3 * (size + below), -1)
        for number, rows, update in waiting[k]:
            np.add.at(front, (number[:, None, None], rows[:, :, None], rows[:, None, :]), update)
        waiting[k], size = [], 3 * size
        pivot = np.tril(front[:, :size, :size])
        pivot += np.tril(pivot, -1).transpose(0, 2, 1) + damping * np.eye(size)
        inverse: Floats = np.asarray(np.linalg.inv(pivot), np.float64)
        side = front[:, size:, :size]
        factor: Floats = side @ inverse
        if below:
            update = front[:, size:, size:] - factor @ side.transpose(0, 2, 1)
            for group, children, rows in tree.parents(which):
                waiting[group].append((tree.number[tree.parent[which[children]]], rows, update[children]))
        factors.append(factor)
        inverses.append(inverse)
    return factors, inverses
