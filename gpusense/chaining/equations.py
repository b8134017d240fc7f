"""Assemble the normal equations of a pose graph: sparse symmetric matrices of 3 x 3 blocks in a fixed layout.

Let d lead from a link's first to its second pose in the world, and let W be its information in the world: the link adds
W to the diagonal block of the second pose, T' W T to the first pose's, and -T' W between both. T converts a small
motion of the first pose to a motion of the second: the identity with a lever -d_y, d_x of headings.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gpusense._util.typing import Floats, Integers

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
        row, column, self._slot = self._slots(place)
        self._lay_out(row, column)

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

    def _lay_out(self, row: Integers, column: Integers) -> None:
        """Find the place of each number of the blocks in the arrays of a compressed matrix."""
        size, k = len(self.rows), np.arange(3)
        begin = np.searchsorted(column, np.arange(size + 1))
        each = np.diff(begin)
        rank = np.arange(len(row)) - begin[column]
        # Numbers in row m and column k of a block are numbered 3 m + k.
        place = 9 * begin[column] + 3 * rank + 3 * each[column] * k[None, :, None] + k[:, None, None]
        self._gather = np.empty(9 * len(row), np.int64)
        self._gather[place.ravel()] = np.arange(9 * len(row))
        self._indices = np.empty(9 * len(row), np.int32)
        self._indices[place.ravel()] = np.broadcast_to(3 * row + k[:, None, None], place.shape).ravel()
        self._starts = np.append((9 * begin[:-1, None] + 3 * each[:, None] * k).ravel(), 9 * len(row)).astype(np.int32)
        self._diagonal = np.flatnonzero(row == column)

    def at(self, poses: Floats, information: Floats, pull: Floats, damping: float | Floats = 0.0) -> tuple[Any, Floats]:
        """Return the sparse matrix (3 N - 3, 3 N - 3) and the gradient (3 N - 3,) at (N, 3) poses.

        ``information`` (L, 3, 3) includes the links' weights, ``pull`` (L, 3) is its product with the residuals, and
        ``damping`` a number or one per free pose.
        """
        from scipy import sparse

        turned, pull, lever = _turned(poses, self.first, self.second, information, pull)
        blocks = _sums(self._slot, _blocks_of(turned, lever), len(self._indices) // 9 + 1)[:, :-1]
        blocks[::4, self._diagonal] += damping
        ends = np.stack([-pull[0], -pull[1], lever[1] * pull[0] - lever[0] * pull[1] - pull[2]])
        gradient = _sums(self.first, ends, len(poses)) + _sums(self.second, pull, len(poses))
        size = 3 * len(self.rows)
        matrix = sparse.csc_matrix((blocks.ravel()[self._gather], self._indices, self._starts), shape=(size, size))
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
