"""Error-free transformations: a second number holds the rounding error of an operation.

Source: Knuth (``two_sum``), Dekker and Veltkamp (``two_product``).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gpusense.interface.constants import BLOCK_TERMS, STRANDS

Pair = tuple[np.ndarray, np.ndarray]


def two_sum(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return ``a + b = sum + error`` exactly."""
    total = a + b
    shift = total - a
    return total, (a - (total - shift)) + (b - shift)


def ordered_sum(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return ``a + b = sum + error`` exactly, where a's exponent is at least b's: Dekker's sum."""
    total = a + b
    return total, b - (total - a)


def high_half(a: np.ndarray) -> np.ndarray:
    """Return the leading bits of a float, so few that the product of two such halves is exact."""
    splitter = a.dtype.type(134217729 if a.dtype == np.float64 else 4097)
    scaled = splitter * a
    return scaled - (scaled - a)


def two_product(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return ``a * b = product + error`` exactly, barring overflow and underflow."""
    product = a * b
    a_high, b_high = high_half(a), high_half(b)
    a_low, b_low = a - a_high, b - b_high
    return product, ((a_high * b_high - product) + a_high * b_low + a_low * b_high) + a_low * b_low


def rest_of(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Return ``c - a * b``, where c is a b rounded or nearly so."""
    product, error = two_product(a, b)
    return (c - product) - error


def pair_sum(a: Pair, b: Pair) -> Pair:
    """Add two numbers of two parts each, to about twice the working precision.

    When the first parts cancel, their sum is at least the last bit of either, so its exponent is no smaller than the
    second parts' exponent.
    """
    total, error = two_sum(a[0], b[0])
    return ordered_sum(total, error + (a[1] + b[1]))


def pair_product(a: Pair, b: Pair) -> Pair:
    """Multiply two numbers of two parts each, to about twice the working precision."""
    product, error = two_product(a[0], b[0])
    return ordered_sum(product, error + (a[0] * b[1] + a[1] * b[0]))


def add_term(total: tuple[np.ndarray, np.ndarray], term: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Add a term to a compensated sum: the running sum, and the sum of its rounding errors."""
    head, lost = two_sum(total[0], term)
    return head, total[1] + lost


def where_pair(when: np.ndarray, a: Pair, b: Pair) -> Pair:
    """Choose between two numbers of two parts each, element by element."""
    return np.where(when, a[0], b[0]), np.where(when, a[1], b[1])


def strands_in(terms: Any) -> Any:
    """Return the number of strands of a number of terms: STRANDS per whole block, at most one per remaining term."""
    return terms // BLOCK_TERMS * STRANDS + np.minimum(terms % BLOCK_TERMS, STRANDS)


def block_sums(term: np.ndarray) -> np.ndarray:
    """Return plain sums of the terms of each block, of (M, K) terms."""
    return _sums(term, 1)


def strand_sums(term: np.ndarray) -> np.ndarray:
    """Return (M, strands_in(K)) plain sums of the strands of each block, of (M, K) terms."""
    return _sums(term, STRANDS)[:, : strands_in(term.shape[1])]


def _sums(term: np.ndarray, strands: int) -> np.ndarray:
    rows, count = term.shape
    blocks = np.zeros((rows, -(-count // BLOCK_TERMS) * BLOCK_TERMS), term.dtype)
    blocks[:, :count] = term
    blocks = blocks.reshape(rows, -1, BLOCK_TERMS // strands, strands)
    total = np.zeros_like(blocks[:, :, 0])
    for k in range(BLOCK_TERMS // strands):
        total += blocks[:, :, k]
    return total.reshape(rows, -1)
