"""Bounds of poses, in float64 and exact.

Work-items are a multiple of three, so that each of them sees one column. A first launch bounds the poses, and a second
one bounds the results of the first, which fill two halves.
"""

import functools

import warp as wp

from .prelude import kernel

INFINITE, MINUS_INFINITE = wp.constant(wp.float64(float("inf"))), wp.constant(wp.float64(float("-inf")))


@functools.cache
def make(name, flags):
    """Make a kernel of the file for a set of flags."""

    @kernel(flags)
    def bound_numbers(number, bounds, count, apart, items):
        """Write the least of some numbers, and the largest of the numbers that lie apart from them: one work-item takes
        every items-th number. NaN remains.
        """
        i = wp.tid()
        if i >= items:
            return
        low = INFINITE
        high = MINUS_INFINITE
        for n in range(i, count, items):
            a = wp.float64(number[n])
            b = wp.float64(number[apart + n])
            low = wp.where(a < low or a != a, a, low)
            high = wp.where(b > high or b != b, b, high)
        bounds[i] = low
        bounds[items + i] = high

    return locals()[name]
