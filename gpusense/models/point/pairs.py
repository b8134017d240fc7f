"""Arguments of kernels to twice a model's precision: computed with 50 digits, split into high and low parts.

The logarithm of a high peak and the exponent nearly cancel, so every digit of either counts.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from decimal import Decimal, localcontext

import numpy as np

PI = Decimal("3.14159265358979323846264338327950288419716939937511")
DIGITS = 50


def exact(value: float) -> Decimal:
    """Return a float without rounding."""
    return Decimal(value)


def log_of(value: Decimal | float) -> Decimal | float:
    """Return the natural logarithm with 50 digits; -inf of 0."""
    with localcontext(prec=DIGITS):
        return Decimal(value).ln() if value > 0 else -math.inf


def total(*values: Decimal | float) -> Decimal | float:
    """Return a sum of logarithms; -inf if any term is -inf."""
    with localcontext(prec=DIGITS):
        return sum((Decimal(v) for v in values), Decimal(0)) if all(map(math.isfinite, values)) else -math.inf


def two_parts(values: Iterable[Decimal | float], real: np.dtype) -> list[np.floating]:
    """Return each number rounded, and its rounding error (low part), 0 for infinite ones."""
    parts = []
    with localcontext(prec=DIGITS):
        for value in values:
            high = real.type(float(value))
            rest = Decimal(value) - Decimal(float(high)) if math.isfinite(value) else 0
            parts += [high, real.type(float(rest))]
    return parts
