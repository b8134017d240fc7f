"""Exponents and logarithms that the densities of absolute, radio and contact sensors share.

Where a density's peak is high, exponent and log peak are large and nearly cancel: both are sums of two numbers.
"""

from __future__ import annotations

import numpy as np

from gpusense.reference.error_free import Pair, pair_product


def bounded_square(u: Pair) -> Pair:
    """The square of a sum of two numbers. Roots above a bound are held there, so that nothing becomes infinite."""
    most = u[0].dtype.type(1e140 if u[0].dtype == np.float64 else 1e17)
    large = np.abs(u[0]) > most
    held = np.where(large, most, u[0]), np.where(large, 0, u[1])
    return pair_product(held, held)


def log_one_plus(x: np.ndarray) -> np.ndarray:
    """``log(1 + x)``, x > -1."""
    return np.log1p(x)


def either(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Logarithm of the sum of two probabilities that are given as logarithms; -inf only where both are 0."""
    high, low = np.maximum(a, b), np.minimum(a, b)
    safe = np.where(np.isneginf(high), 0, high)
    return np.where(np.isneginf(high), high, safe + log_one_plus(np.exp(low - safe)))
