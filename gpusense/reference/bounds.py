"""Bounds of poses, in float64 and exact.

Work-items are a multiple of three, so that each of them sees one column. A first launch bounds the poses, and a second
one bounds the results of the first, which fill two halves.
"""

from __future__ import annotations

import numpy as np


def bound_numbers(
    flags: frozenset[str], number: np.ndarray, bounds: np.ndarray, count: int, apart: int, items: int
) -> None:
    """Write the least of some numbers, and the largest of the numbers that lie apart from them; NaN remains.

    Work-item ``i`` takes every ``items``-th number from ``i`` on.
    """
    rows = -(-count // items)
    for half, first, reduce, beyond in ((0, 0, np.minimum.reduce, np.inf), (1, apart, np.maximum.reduce, -np.inf)):
        padded = np.full(rows * items, beyond)
        padded[:count] = number[first : first + count]
        bounds[half * items : (half + 1) * items] = reduce(padded.reshape(rows, items), axis=0)
