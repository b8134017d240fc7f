"""Columns of the numbers of S matches: arrays (S,), or Python's numbers where there is a single match.

An operation on an array of one number takes 20 times as long as on a number. Both round alike: sums, products,
quotients, remainders and square roots. Other functions are array functions, also for numbers, so the same results of
the kernel give a single match the same bits as in a batch, except for the axes of its information. Denominators must
not be 0, and conditions are negated by :func:`is_not`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

Column = Any


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
