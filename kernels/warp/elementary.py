"""Exponential, logarithm and angle in float64 from +, -, *, / and sqrt alone: every device gives the same bits."""

import warp as wp

from gpusense.interface import formulas

from .prelude import doubles

f = doubles(formulas)
ZERO, ONE = wp.float64(0.0), wp.float64(1.0)
TWO, FOUR = wp.float64(2.0), wp.float64(4.0)
BIAS, MANTISSA_BITS = wp.int64(1023), wp.int64(52)
MANTISSA, HALF_BITS = wp.int64(0xFFFFFFFFFFFFF), wp.int64(0x3FE0000000000000)


@wp.func
def exp_of(x: wp.float64):
    """Return exp(x) for x <= 700; 0 below LEAST_EXPONENT."""
    held = wp.where(x > f.LEAST_EXPONENT, x, ZERO)
    count = (held * f.INVERSE_LOG2 + f.ROUNDER) - f.ROUNDER
    r = (held - count * f.LOG2_HIGH) - count * f.LOG2_LOW
    series = f.EXP[0]
    for i in range(1, 12):
        series = series * r + f.EXP[i]
    power = wp.cast((wp.int64(count) + BIAS) << MANTISSA_BITS, wp.float64)
    return wp.where(x > f.LEAST_EXPONENT, (ONE + (r + r * r * series)) * power, ZERO)


@wp.func
def odd_series(z: wp.float64):
    """Return the power series of the logarithm and of the angle."""
    series = f.ODD[0]
    for i in range(1, 11):
        series = series * z + f.ODD[i]
    return series


@wp.func
def log_of(x: wp.float64):
    """Return log(x) of a normal number x > 0."""
    bits = wp.cast(x, wp.int64)
    m = wp.cast((bits & MANTISSA) | HALF_BITS, wp.float64)
    small = m < f.SQRT_HALF
    exponent = wp.float64((bits >> MANTISSA_BITS) - BIAS) + wp.where(small, ZERO, ONE)
    scaled = wp.where(small, TWO * m, m)
    s = (scaled - ONE) / (scaled + ONE)
    z = s * s
    return exponent * f.LOG2_HIGH + (TWO * s + (TWO * s * z * odd_series(z) + exponent * f.LOG2_LOW))


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
    angle = wp.where(size_y > size_x, f.QUARTER - angle, angle)
    angle = wp.where(x < ZERO, f.HALF_TURN - angle, angle)
    return wp.where(y < ZERO, -angle, angle)
