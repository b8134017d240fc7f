"""Offsets between places, and exponents and logarithms of densities of sensors other than scanners.

All are sums of two numbers: a relative error of eps in 20 m is too large for a deviation of 1 cm, and exponent and log
peak are large and nearly cancel where a density's peak is high. A place is (x, its low part, y, its low part), and so
is an offset.
"""

from __future__ import annotations

import numpy as np

from gpusense.reference.error_free import Pair, pair_product, two_product, two_sum

Quad = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def offset(landmark: np.ndarray, place: Quad) -> Quad:
    """Return offsets from sensors to landmarks or beacons (x, y, and the low parts of both)."""
    x, y = two_sum(landmark[:, 0], -place[0]), two_sum(landmark[:, 1], -place[2])
    x = two_sum(x[0], x[1] + (landmark[:, 2] - place[1]))
    y = two_sum(y[0], y[1] + (landmark[:, 3] - place[3]))
    return *x, *y


def distance_pair(off: Quad) -> Pair:
    """Return the length of an offset: the rounded root, and the correction of one step of Newton's method."""
    xx, yy = two_product(off[0], off[0]), two_product(off[2], off[2])
    d, total = np.sqrt(xx[0] + yy[0]), two_sum(xx[0], yy[0])
    dd = two_product(d, d)
    rest = (total[0] - dd[0]) + ((total[1] + ((xx[1] + yy[1]) - dd[1])) + 2 * (off[0] * off[1] + off[2] * off[3]))
    return d, np.where(d > 0, rest / np.where(d > 0, 2 * d, 1), 0).astype(d.dtype)


def bounded_square(u: Pair) -> Pair:
    """Return the square of a sum of two numbers; roots are clamped, so that nothing becomes infinite."""
    most = u[0].dtype.type(1e140 if u[0].dtype == np.float64 else 1e17)
    large = np.abs(u[0]) > most
    held = np.where(large, most, u[0]), np.where(large, 0, u[1])
    return pair_product(held, held)


def log_one_plus(x: np.ndarray) -> np.ndarray:
    """Return ``log(1 + x)`` for x > -1."""
    return np.log1p(x)


def either(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the log of the sum of two probabilities, from their logs; -inf only where both are 0."""
    high, low = np.maximum(a, b), np.minimum(a, b)
    safe = np.where(np.isneginf(high), 0, high)
    return np.where(np.isneginf(high), high, safe + log_one_plus(np.exp(low - safe)))
