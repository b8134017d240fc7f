"""Exponential, logarithm and angle in float64 from +, -, *, / and sqrt alone, so that every device gives the same bits.

exp x = 2^k exp r with r = x - k log 2, |r| <= log(2) / 2, by its power series. log x = e log 2 + 2 artanh s with x = m
2^e, sqrt(1/2) <= m < sqrt 2 and s = (m - 1) / (m + 1). atan t with t <= 1 is 4 atan t'', where t' = t / (1 + sqrt(1 +
t^2)) halves the angle. Errors are a few units in the last place.
"""

from __future__ import annotations

import numpy as np

from gpusense.interface import formulas as f


def exp_of(x: np.ndarray) -> np.ndarray:
    """Return ``exp(x)`` for x <= 700; 0 below LEAST_EXPONENT."""
    held = np.where(x > f.LEAST_EXPONENT, x, 0.0)
    count = (held * f.INVERSE_LOG2 + f.ROUNDER) - f.ROUNDER
    r = (held - count * f.LOG2_HIGH) - count * f.LOG2_LOW
    series = np.full_like(r, f.EXP[0])
    for term in f.EXP[1:]:
        series = series * r + term
    power = ((count.astype(np.int64) + 1023) << 52).view(np.float64)
    return np.where(x > f.LEAST_EXPONENT, (1.0 + (r + r * r * series)) * power, 0.0)


def odd_series(z: np.ndarray) -> np.ndarray:
    """Return the power series of the logarithm and of the angle."""
    series = np.full_like(z, f.ODD[0])
    for term in f.ODD[1:]:
        series = series * z + term
    return series


def log_of(x: np.ndarray) -> np.ndarray:
    """Return ``log(x)`` of a normal number x > 0."""
    bits = np.asarray(x, np.float64).view(np.int64)
    exponent = ((bits >> 52) - 1023).astype(np.float64)
    m = ((bits & 0xFFFFFFFFFFFFF) | 0x3FE0000000000000).view(np.float64)
    small = m < f.SQRT_HALF
    m = np.where(small, 2.0 * m, m)
    exponent = np.where(small, exponent, exponent + 1.0)
    s = (m - 1.0) / (m + 1.0)
    z = s * s
    return exponent * f.LOG2_HIGH + (2.0 * s + (2.0 * s * z * odd_series(z) + exponent * f.LOG2_LOW))


def angle_of(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the angle of a vector in [-pi, pi]; 0 for the vector 0."""
    size_x, size_y = np.abs(x), np.abs(y)
    high, low = np.maximum(size_x, size_y), np.minimum(size_x, size_y)
    t = low / np.where(high > 0.0, high, 1.0)
    for _ in range(2):
        t = t / (1.0 + np.sqrt(1.0 + t * t))
    z = -(t * t)
    angle = 4.0 * (t + t * z * odd_series(z))
    angle = np.where(size_y > size_x, f.QUARTER - angle, angle)
    angle = np.where(x < 0.0, f.HALF_TURN - angle, angle)
    return np.where(y < 0.0, -angle, angle)
