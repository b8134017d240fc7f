"""Exponential, logarithm and error function by arithmetic alone: opencl/lanes/math.cl, a number at a time.

LLVM makes vectors of loops over them, and none of loops that call the C library. With |r| <= log(2) / 2 and 1 + f from
sqrt(1/2) to sqrt(2): e^a = 2^k e^r, e^r = 1 + r + r^2 E(r); log(2^k (1 + f)) = k log 2 + f - f^2 / 2 + f^3 L(f);
erf(x) = 1 - exp(-x W(x)). bench/derive/lane_constants.py derives the constants. float64 has the functions of
elementary.py.
"""

import warp as wp

from gpusense.interface.constants import POLYNOMIALS

from ..elementary import exp_of, log_of
from ..flags import FLOAT64

_number = wp.float32


def _numbers(*values):
    """Return constants of float32."""
    return tuple(_number(value) for value in values)


ZERO, HALF, ONE = _numbers(0.0, 0.5, 1.0)
# log 2 in two parts; the first has 16 bits, so that its products with counts are exact.
LOG2_HIGH, LOG2_LOW, ONE_OVER_LOG2 = _numbers(0.693145752, 1.42860677e-06, 1.44269502)
# 1.5 * 2^23: a sum with it is rounded to a whole number, held in its last bits.
ROUNDER = _number(12582912.0)
ROUNDER_BITS = wp.int32(0x4B400000)
# e^EXP_ZERO is close to the smallest normal number; e^EXP_LOST is below half of the last bit of 1.
EXP_ZERO, EXP_LOST = _numbers(-87.0, -20.0)
EXPONENT_BIAS, MANTISSA_BITS = wp.int32(127), wp.int32(23)
MANTISSA = wp.int32(0x7FFFFF)
# Bits of sqrt(1/2).
ROOT_HALF = wp.int32(0x3F3504F3)
# From here on the error function is 1 to the last bit.
ERF_ONE = _number(4.0)
E0, E1, E2, E3, E4 = _numbers(*POLYNOMIALS["E"])
L0, L1, L2, L3, L4, L5, L6, L7 = _numbers(*POLYNOMIALS["L"])
W0, W1, W2, W3, W4, W5, W6, W7, W8 = _numbers(*POLYNOMIALS["W"])


@wp.func
def reduced_exp_lanes(a: wp.float32):
    """Return e^r - 1 and the count k of e^a. Polynomials are summed in pairs, which processors compute side by side."""
    shifted = a * ONE_OVER_LOG2 + ROUNDER
    k = shifted - ROUNDER
    r = (a - k * LOG2_HIGH) - k * LOG2_LOW
    square = r * r
    rest = r + square * ((E0 + E1 * r) + square * ((E2 + E3 * r) + square * E4))
    return rest, wp.cast(shifted, wp.int32) - ROUNDER_BITS


@wp.func
def exp_lanes(a: wp.float32):
    """Return e^a for a <= 0; 0 where it would be denormal."""
    rest, k = reduced_exp_lanes(a)
    power = (ONE + rest) * wp.cast((k + EXPONENT_BIAS) << MANTISSA_BITS, wp.float32)
    return wp.where(a < EXP_ZERO, ZERO, power)


@wp.func
def one_minus_exp_lanes(a: wp.float32):
    """Return 1 - e^a for a <= 0. Nothing cancels: where the count is 0, so is the first term."""
    rest, k = reduced_exp_lanes(wp.where(a < EXP_LOST, EXP_LOST, a))
    scale = wp.cast((k + EXPONENT_BIAS) << MANTISSA_BITS, wp.float32)
    return (ONE - scale) - scale * rest


@wp.func
def log_lanes(p: wp.float32):
    """Return log(p) of a finite normal number p > 0."""
    above = wp.cast(p, wp.int32) - ROOT_HALF
    k = wp.float32(above >> MANTISSA_BITS)
    f = wp.cast((above & MANTISSA) + ROOT_HALF, wp.float32) - ONE
    square = f * f
    low = (L0 + L1 * f) + square * (L2 + L3 * f)
    high = (L4 + L5 * f) + square * (L6 + L7 * f)
    cubic = (square * f) * (low + (square * square) * high)
    return (f + ((cubic + k * LOG2_LOW) - HALF * square)) + k * LOG2_HIGH


@wp.func
def erf_lanes(x: wp.float32):
    """Return erf(x) for x >= 0; exactly 1 from ERF_ONE on."""
    b = wp.where(x < ERF_ONE, x, ERF_ONE)
    square = b * b
    low = (W0 + W1 * b) + square * (W2 + W3 * b)
    high = (W4 + W5 * b) + square * ((W6 + W7 * b) + square * W8)
    return one_minus_exp_lanes(-b * (low + (square * square) * high))


if FLOAT64:
    exp_lanes, log_lanes = exp_of, log_of
