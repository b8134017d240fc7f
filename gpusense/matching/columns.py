"""Columns of the numbers of S matches: arrays (S,), or Python's numbers where there is a single match.

Triangles are symmetric 3x3 matrices of S matches: columns xx, xy, xt, yy, yt, tt for x, y and heading. A function of
``numpy.linalg`` takes 5 us for a single matrix; sums and products of six of Python's numbers take a third of one.

An operation on an array of one number takes 20 times as long as on a number. Both round alike: sums, products,
quotients, remainders and square roots. Other functions are array functions, also for numbers, so the same results of
the kernel give a single match the same bits as in a batch, except for the axes of its information. Denominators must
not be 0, and conditions are negated by :func:`is_not`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

Column = Any
Triangle = Sequence[Column]
Vector = tuple[float, float, float]

# Places of the numbers of an upper triangle in the rows of a matrix, and of a matrix's numbers in its triangle.
UPPER = np.array([0, 1, 2, 4, 5, 8])
_BOTH = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
# Pivots below this are not divisors.
_LEAST_PIVOT = 1e-30
# Jacobi's rotations end when all off-diagonal numbers are below this share of the trace, or after these sweeps.
_ROUNDING, _SWEEPS = 1e-16, 12


def columns_of(rows: np.ndarray) -> Any:
    """Return the columns of rows (S, N)."""
    return rows[0].tolist() if len(rows) == 1 else rows.T


def rows_of(columns: Any) -> np.ndarray:
    """Return columns as rows (S, N) of real numbers."""
    return np.stack(columns, axis=1) if isinstance(columns[0], np.ndarray) else np.array([columns], np.float64)


def column_of(values: Column) -> Column:
    """Return values (S,) as a column."""
    return values.item() if isinstance(values, np.ndarray) and len(values) == 1 else values


def values_of(column: Column) -> np.ndarray:
    """Return a column as values (S,)."""
    return column if isinstance(column, np.ndarray) else np.array([column])


def larger(one: Column, other: Column) -> Column:
    """Return the larger of two columns."""
    if isinstance(one, np.ndarray) or isinstance(other, np.ndarray):
        return np.maximum(one, other)
    return other if one < other else one


def smaller(one: Column, other: Column) -> Column:
    """Return the smaller of two columns."""
    if isinstance(one, np.ndarray) or isinstance(other, np.ndarray):
        return np.minimum(one, other)
    return other if other < one else one


def chosen(condition: Column, one: Column, other: Column) -> Column:
    """Return one of two columns where a condition holds, and the other one elsewhere."""
    if isinstance(condition, np.ndarray):
        return np.where(condition, one, other)
    return one if condition else other


def cosine_and_sine(angle: Column) -> tuple[Column, Column]:
    """Return the cosines and sines of a column of angles [rad]."""
    c, s = np.cos(angle), np.sin(angle)
    # Operations on NumPy's numbers take three times as long as on Python's.
    return (c, s) if isinstance(c, np.ndarray) else (float(c), float(s))


def square_root(column: Column) -> Column:
    """Return the square roots of a column without negative numbers."""
    return np.sqrt(column) if isinstance(column, np.ndarray) else math.sqrt(column)


def is_not(condition: Column) -> Column:
    """Return where a condition does not hold."""
    return ~condition if isinstance(condition, np.ndarray) else not condition


def any_of(column: Column) -> bool:
    """Return whether a condition holds for any match."""
    return bool(column.any()) if isinstance(column, np.ndarray) else bool(column)


def all_of(column: Column) -> bool:
    """Return whether a condition holds for all matches."""
    return bool(column.all()) if isinstance(column, np.ndarray) else bool(column)


def upright(column: Column, axes: int = 1) -> Column:
    """Return a column with trailing axes of length 1, to multiply vectors or matrices of matches."""
    return column.reshape(-1, *[1] * axes) if isinstance(column, np.ndarray) else column


# ---- triangles


def triangle_of(matrices: np.ndarray) -> Triangle:
    """Return the triangles of symmetric matrices (S, 3, 3)."""
    if len(matrices) != 1:
        return [*matrices.reshape(-1, 9).T[UPPER]]
    xx, xy, xt, _, yy, yt, _, _, tt = matrices.ravel().tolist()
    return xx, xy, xt, yy, yt, tt


def matrices_of(triangle: Triangle) -> np.ndarray:
    """Return triangles as matrices (S, 3, 3)."""
    xx, xy, xt, yy, yt, tt = triangle
    if isinstance(xx, np.ndarray):
        return np.stack(triangle, axis=1)[:, _BOTH]
    return np.array([[[xx, xy, xt], [xy, yy, yt], [xt, yt, tt]]])


def balanced(triangle: Triangle, lever: Column) -> Triangle:
    """Return matrices of x, y and ``lever`` times the heading from those of x, y and the heading."""
    xx, xy, xt, yy, yt, tt = triangle
    factor = 1 / lever
    return xx, xy, xt * factor, yy, yt * factor, tt * (factor * factor)


def is_definite(triangle: Triangle) -> Column:
    """Return whether all eigenvalues are positive, by the pivots of an elimination."""
    xx, xy, xt, yy, yt, tt = triangle
    first = larger(xx, _LEAST_PIVOT)
    aside, across = xy / first, xt / first
    second, beside = yy - aside * xy, yt - aside * xt
    third = tt - across * xt - beside * beside / larger(second, _LEAST_PIVOT)
    return (xx > 0) & (second > 0) & (third > 0)


def inverse_of(triangle: Triangle) -> Triangle:
    """Return the inverses of positive definite matrices, by factors L D L'; all numbers of other ones are NaN."""
    xx, xy, xt, yy, yt, tt = triangle
    first = _pivot(xx)
    a, b = xy / first, xt / first
    second, beside = _pivot(yy - a * xy), yt - a * xt
    c = beside / second
    # The first column and the last row of the inverse of L, and the inverse of D.
    d, u, v = a * c - b, 1 / first, 1 / second
    w = 1 / _pivot(tt - b * xt - c * beside)
    return u + a * a * v + d * d * w, -a * v - c * d * w, d * w, v + c * c * w, -c * w, w


def _pivot(number: Column) -> Column:
    """Return positive numbers, and NaN in place of others, as safe divisors of Python's numbers."""
    return chosen(number > 0, number, math.nan)


def moved(triangle: Triangle, x: Column, y: Column) -> Triangle:
    """Return J' A J for matrices A and the derivatives J of poses whose x and y grow by ``x`` and ``y`` a radian."""
    xx, xy, xt, yy, yt, tt = triangle
    across, aside = xt + xx * x + xy * y, yt + xy * x + yy * y
    return xx, xy, across, yy, aside, tt + xt * x + yt * y + across * x + aside * y


def squared_length(triangle: Triangle, x: Column, y: Column, turn: Column) -> Column:
    """Return v' A v for matrices A and vectors v."""
    xx, xy, xt, yy, yt, tt = triangle
    return x * (xx * x + 2 * (xy * y + xt * turn)) + y * (yy * y + 2 * (yt * turn)) + tt * turn * turn


def axes_of_one(triangle: Triangle) -> list[tuple[float, Vector]]:
    """Return ascending eigenvalues of a single matrix, with unit vectors, by Jacobi's rotations."""
    xx, xy, xt, yy, yt, tt = triangle
    least = _ROUNDING * (abs(xx) + abs(yy) + abs(tt))
    a, b, c = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
    for _ in range(_SWEEPS):
        if abs(xy) <= least and abs(xt) <= least and abs(yt) <= least:
            break
        if xy:
            xx, yy, xt, yt, a, b = _rotated(xx, yy, xy, xt, yt, a, b)
            xy = 0.0
        if xt:
            xx, tt, xy, yt, a, c = _rotated(xx, tt, xt, xy, yt, a, c)
            xt = 0.0
        if yt:
            yy, tt, xy, xt, b, c = _rotated(yy, tt, yt, xy, xt, b, c)
            yt = 0.0
    return sorted(((xx, a), (yy, b), (tt, c)))


def _rotated(
    one: float, other: float, both: float, beside: float, across: float, first: Vector, second: Vector
) -> tuple[float, float, float, float, Vector, Vector]:
    """Rotate two axes so that ``both`` becomes 0; return their diagonal, their third row, and their vectors."""
    half = (other - one) / (2 * both)
    tangent = math.copysign(1.0, half) / (abs(half) + math.sqrt(half * half + 1))
    cosine = 1 / math.sqrt(tangent * tangent + 1)
    sine, (a, b, c), (d, e, f) = tangent * cosine, first, second
    return (
        one - tangent * both, other + tangent * both, cosine * beside - sine * across, sine * beside + cosine * across,
        (cosine * a - sine * d, cosine * b - sine * e, cosine * c - sine * f),
        (sine * a + cosine * d, sine * b + cosine * e, sine * c + cosine * f),
    )  # fmt: skip
