"""Offsets between places, and exponents and logarithms of densities of sensors other than scanners."""

import warp as wp

from .error_free import pair_product, two_product, two_sum
from .flags import FLOAT64, IN_LANES
from .prelude import log1p_of_gpu, on_gpu
from .types import real, vec2, vec4

if IN_LANES:
    from .lanes.math import log_lanes as log
else:
    log = wp.log

gpu_log1p = log1p_of_gpu(real)
ZERO, ONE, TWO = real(0.0), real(1.0), real(2.0)
LARGEST_ROOT = real(1e140 if FLOAT64 else 1e17)


@wp.func
def offset(landmark: vec4, place: vec4):
    """Return the offset from a sensor to a landmark or beacon (x, y, and the low parts of both)."""
    x = two_sum(landmark[0], -place[0])
    y = two_sum(landmark[1], -place[2])
    x = two_sum(x[0], x[1] + (landmark[2] - place[1]))
    y = two_sum(y[0], y[1] + (landmark[3] - place[3]))
    return vec4(x[0], x[1], y[0], y[1])


@wp.func
def distance_pair(off: vec4):
    """Return the length of an offset: the rounded root, and the correction of one step of Newton's method."""
    xx = two_product(off[0], off[0])
    yy = two_product(off[2], off[2])
    total = two_sum(xx[0], yy[0])
    d = wp.sqrt(total[0])
    dd = two_product(d, d)
    low = TWO * (off[0] * off[1] + off[2] * off[3])
    rest = (total[0] - dd[0]) + ((total[1] + ((xx[1] + yy[1]) - dd[1])) + low)
    more = real(0.0)
    if d > ZERO:
        more = rest / (TWO * d)
    return vec2(d, more)


@wp.func
def bounded_square(u: vec2):
    """Return the square of a sum of two numbers; roots are clamped, so that nothing becomes infinite."""
    held = u
    if wp.abs(u.x) > LARGEST_ROOT:
        held = vec2(LARGEST_ROOT, ZERO)
    return pair_product(held, held)


@wp.func
def log_one_plus(x: real):
    """Return log(1 + x) for x > -1; on processors the rounding error of 1 + x is corrected to first order."""
    if on_gpu():
        return gpu_log1p(x)
    more = ONE + x
    return log(more) + (x - (more - ONE)) / more


@wp.func
def either(a: real, b: real):
    """Return the log of the sum of two probabilities, from their logs; -inf only where both are 0."""
    high = wp.max(a, b)
    low = wp.min(a, b)
    log_sum = high
    if not wp.isinf(high):
        log_sum = high + log_one_plus(wp.exp(low - high))
    return log_sum
