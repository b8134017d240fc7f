"""Offsets between places in sums of two numbers: a relative error of eps in 20 m is too large for a deviation of 1 cm.

A place is (x, its low part, y, its low part), and so is an offset.
"""

import functools
from types import SimpleNamespace

import warp as wp

from . import error_free
from .prelude import precision


@functools.cache
def functions(flags):
    """Make the functions of the file for a set of flags."""
    types = precision(flags)
    real, vec2, vec4 = types.real, types.vec2, types.vec4
    exact = error_free.functions(flags)
    two_sum, two_product = exact.two_sum, exact.two_product
    ZERO, TWO = real(0.0), real(2.0)

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

    return SimpleNamespace(**locals())
