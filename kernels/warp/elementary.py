"""Exponential, logarithm and angle in float64 from +, -, *, / and sqrt alone: every device gives the same bits."""

import warp as wp

LOG2_HIGH, LOG2_LOW = wp.constant(wp.float64(0.6931471803691238)), wp.constant(wp.float64(1.9082149292705877e-10))
INVERSE_LOG2 = wp.constant(wp.float64(1.4426950408889634))
# 1.5 * 2^52: adding it rounds to an integer.
ROUNDER = wp.constant(wp.float64(6755399441055744.0))
# Below this exponent the result is 0.
LEAST_EXPONENT = wp.constant(wp.float64(-700.0))
SQRT_HALF = wp.constant(wp.float64(0.7071067811865476))
QUARTER, HALF_TURN = wp.constant(wp.float64(1.5707963267948966)), wp.constant(wp.float64(3.141592653589793))
ZERO, ONE = wp.constant(wp.float64(0.0)), wp.constant(wp.float64(1.0))
TWO, FOUR = wp.constant(wp.float64(2.0)), wp.constant(wp.float64(4.0))
# 1 / n! for n = 13, ..., 2, and 1 / (2 n + 1) for n = 11, ..., 1.
terms_12, terms_11 = wp.types.vector(length=12, dtype=wp.float64), wp.types.vector(length=11, dtype=wp.float64)
# fmt: off
EXP = wp.constant(terms_12(
    1.6059043836821613e-10, 2.08767569878681e-09, 2.505210838544172e-08, 2.755731922398589e-07, 2.7557319223985893e-06,
    2.48015873015873e-05, 0.0001984126984126984, 0.001388888888888889, 0.008333333333333333, 0.041666666666666664,
    0.16666666666666666, 0.5,
))
ODD = wp.constant(terms_11(
    0.043478260869565216, 0.047619047619047616, 0.05263157894736842, 0.058823529411764705, 0.06666666666666667,
    0.07692307692307693, 0.09090909090909091, 0.1111111111111111, 0.14285714285714285, 0.2, 0.3333333333333333,
))
# fmt: on
BIAS, MANTISSA_BITS = wp.constant(wp.int64(1023)), wp.constant(wp.int64(52))
MANTISSA, HALF_BITS = wp.constant(wp.int64(0xFFFFFFFFFFFFF)), wp.constant(wp.int64(0x3FE0000000000000))


@wp.func
def exp_of(x: wp.float64):
    """Return exp(x) for x <= 700; 0 below LEAST_EXPONENT."""
    held = wp.where(x > LEAST_EXPONENT, x, ZERO)
    count = (held * INVERSE_LOG2 + ROUNDER) - ROUNDER
    r = (held - count * LOG2_HIGH) - count * LOG2_LOW
    series = EXP[0]
    for i in range(1, 12):
        series = series * r + EXP[i]
    power = wp.cast((wp.int64(count) + BIAS) << MANTISSA_BITS, wp.float64)
    return wp.where(x > LEAST_EXPONENT, (ONE + (r + r * r * series)) * power, ZERO)


@wp.func
def odd_series(z: wp.float64):
    """Return the power series of the logarithm and of the angle."""
    series = ODD[0]
    for i in range(1, 11):
        series = series * z + ODD[i]
    return series


@wp.func
def log_of(x: wp.float64):
    """Return log(x) of a normal number x > 0."""
    bits = wp.cast(x, wp.int64)
    m = wp.cast((bits & MANTISSA) | HALF_BITS, wp.float64)
    small = m < SQRT_HALF
    exponent = wp.float64((bits >> MANTISSA_BITS) - BIAS) + wp.where(small, ZERO, ONE)
    scaled = wp.where(small, TWO * m, m)
    s = (scaled - ONE) / (scaled + ONE)
    z = s * s
    return exponent * LOG2_HIGH + (TWO * s + (TWO * s * z * odd_series(z) + exponent * LOG2_LOW))


@wp.func
def angle_of(x: wp.float64, y: wp.float64):
    """Return the angle of a vector in [-pi, pi]; 0 for the vector 0."""
    size_x = wp.abs(x)
    size_y = wp.abs(y)
    high = wp.max(size_x, size_y)
    t = wp.min(size_x, size_y) / wp.where(high > ZERO, high, ONE)
    t = t / (ONE + wp.sqrt(ONE + t * t))
    t = t / (ONE + wp.sqrt(ONE + t * t))
    z = -(t * t)
    angle = FOUR * (t + t * z * odd_series(z))
    angle = wp.where(size_y > size_x, QUARTER - angle, angle)
    angle = wp.where(x < ZERO, HALF_TURN - angle, angle)
    return wp.where(y < ZERO, -angle, angle)
