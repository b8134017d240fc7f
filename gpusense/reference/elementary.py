"""Exponential, logarithm and angle in float64 from +, -, *, / and sqrt alone, so that every device gives the same bits.

exp x = 2^k exp r with r = x - k log 2, |r| <= log(2) / 2, by its power series. log x = e log 2 + 2 artanh s with x = m
2^e, sqrt(1/2) <= m < sqrt 2 and s = (m - 1) / (m + 1). atan t with t <= 1 is 4 atan t'', where t' = t / (1 + sqrt(1 +
t^2)) halves the angle. Errors are a few units in the last place.
"""

from __future__ import annotations

import numpy as np

LOG2_HIGH, LOG2_LOW = 0.6931471803691238, 1.9082149292705877e-10
INVERSE_LOG2 = 1.4426950408889634
# 1.5 * 2^52: adding it rounds to an integer.
ROUNDER = 6755399441055744.0
# Below this exponent the result is 0.
LEAST_EXPONENT = -700.0
SQRT_HALF = 0.7071067811865476
QUARTER, HALF_TURN = 1.5707963267948966, 3.141592653589793
# 1 / n! for n = 13, ..., 2, and 1 / (2 n + 1) for n = 11, ..., 1.
EXP = (
    1.6059043836821613e-10, 2.08767569878681e-09, 2.505210838544172e-08, 2.755731922398589e-07, 2.7557319223985893e-06,
    2.48015873015873e-05, 0.0001984126984126984, 0.001388888888888889, 0.008333333333333333, 0.041666666666666664,
    0.16666666666666666, 0.5,
)  # fmt: skip
ODD = (
    0.043478260869565216, 0.047619047619047616, 0.05263157894736842, 0.058823529411764705, 0.06666666666666667,
    0.07692307692307693, 0.09090909090909091, 0.1111111111111111, 0.14285714285714285, 0.2, 0.3333333333333333,
)  # fmt: skip


def exp_of(x: np.ndarray) -> np.ndarray:
    """Return ``exp(x)`` for x <= 700; 0 below LEAST_EXPONENT."""
    held = np.where(x > LEAST_EXPONENT, x, 0.0)
    count = (held * INVERSE_LOG2 + ROUNDER) - ROUNDER
    r = (held - count * LOG2_HIGH) - count * LOG2_LOW
    series = np.full_like(r, EXP[0])
    for term in EXP[1:]:
        series = series * r + term
    power = ((count.astype(np.int64) + 1023) << 52).view(np.float64)
    return np.where(x > LEAST_EXPONENT, (1.0 + (r + r * r * series)) * power, 0.0)


def odd_series(z: np.ndarray) -> np.ndarray:
    """Return the power series of the logarithm and of the angle."""
    series = np.full_like(z, ODD[0])
    for term in ODD[1:]:
        series = series * z + term
    return series


def log_of(x: np.ndarray) -> np.ndarray:
    """Return ``log(x)`` of a normal number x > 0."""
    bits = np.asarray(x, np.float64).view(np.int64)
    exponent = ((bits >> 52) - 1023).astype(np.float64)
    m = ((bits & 0xFFFFFFFFFFFFF) | 0x3FE0000000000000).view(np.float64)
    small = m < SQRT_HALF
    m = np.where(small, 2.0 * m, m)
    exponent = np.where(small, exponent, exponent + 1.0)
    s = (m - 1.0) / (m + 1.0)
    z = s * s
    return exponent * LOG2_HIGH + (2.0 * s + (2.0 * s * z * odd_series(z) + exponent * LOG2_LOW))


def angle_of(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the angle of a vector in [-pi, pi]; 0 for the vector 0."""
    size_x, size_y = np.abs(x), np.abs(y)
    high, low = np.maximum(size_x, size_y), np.minimum(size_x, size_y)
    t = low / np.where(high > 0.0, high, 1.0)
    for _ in range(2):
        t = t / (1.0 + np.sqrt(1.0 + t * t))
    z = -(t * t)
    angle = 4.0 * (t + t * z * odd_series(z))
    angle = np.where(size_y > size_x, QUARTER - angle, angle)
    angle = np.where(x < 0.0, HALF_TURN - angle, angle)
    return np.where(y < 0.0, -angle, angle)
