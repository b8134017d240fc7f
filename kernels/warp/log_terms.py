"""Exponents and logarithms that the densities of absolute, radio and contact sensors share.

Where a density's peak is high, exponent and log peak are large and nearly cancel: both are sums of two numbers.
"""

import functools
from types import SimpleNamespace

import warp as wp

from . import error_free
from .prelude import precision


@functools.cache
def functions(flags):
    """bounded_square, log_one_plus and either in the precision of the flags."""
    types = precision(flags)
    real, vec2 = types.real, types.vec2
    pair_product = error_free.functions(flags).pair_product
    ZERO, ONE = real(0.0), real(1.0)
    LARGEST_ROOT = real(1e140 if "FLOAT64" in flags else 1e17)

    # The square of a sum of two numbers. Roots above a bound are held there, so that nothing becomes infinite.
    @wp.func
    def bounded_square(u: vec2):
        held = u
        if wp.abs(u.x) > LARGEST_ROOT:
            held = vec2(LARGEST_ROOT, ZERO)
        return pair_product(held, held)

    # log(1 + x), x > -1: what the sum with 1 rounds away is put back, to the first order.
    @wp.func
    def log_one_plus(x: real):
        more = ONE + x
        return wp.log(more) + (x - (more - ONE)) / more

    # Logarithm of the sum of two probabilities that are given as logarithms; -inf only where both are 0.
    @wp.func
    def either(a: real, b: real):
        high = wp.max(a, b)
        low = wp.min(a, b)
        log_sum = high
        if not wp.isinf(high):
            log_sum = high + log_one_plus(wp.exp(low - high))
        return log_sum

    return SimpleNamespace(bounded_square=bounded_square, log_one_plus=log_one_plus, either=either)
