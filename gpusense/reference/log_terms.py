"""Exponents and logarithms for the densities of absolute, radio and contact sensors.

Exponent and log peak are large and nearly cancel where a density's peak is high: both are sums of two numbers.
"""

from __future__ import annotations

import numpy as np

from gpusense.reference.error_free import Pair, pair_product


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
