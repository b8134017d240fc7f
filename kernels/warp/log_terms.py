"""Exponents and logarithms for the densities of absolute, radio and contact sensors.

Exponent and log peak are large and nearly cancel where a density's peak is high: both are sums of two numbers.
"""

import functools
from types import SimpleNamespace

import warp as wp

from . import error_free
from .lanes import math as lane_math
from .prelude import fuses_on_gpu, log1p_of_gpu, precision


@functools.cache
def functions(flags):
    """Make the functions of the file for a set of flags."""
    types = precision(flags)
    real, vec2 = types.real, types.vec2
    gpu_log1p = log1p_of_gpu(real)
    pair_product = error_free.functions(flags).pair_product
    log = lane_math.functions(flags).log_lanes if "IN_LANES" in flags else wp.log
    ZERO, ONE = real(0.0), real(1.0)
    LARGEST_ROOT = real(1e140 if "FLOAT64" in flags else 1e17)

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
        if fuses_on_gpu():
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

    return SimpleNamespace(**locals())
