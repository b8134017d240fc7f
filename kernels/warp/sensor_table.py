"""The density of one reading from a table of log p over bins of readings and expected ranges, instead of a formula.

Row i is a bin of readings; column j a bin of expected ranges, and the last column is for rays without an obstacle. The
table has fewer than 2^31 entries.
"""

import functools
from types import SimpleNamespace

import warp as wp

from .prelude import precision


@functools.cache
def functions(flags):
    """range_bin and tabulated_density in the precision of the flags."""
    real = precision(flags).real

    # Bin of a range; what is at the end or beyond belongs to the last one.
    @wp.func
    def range_bin(distance: real, per_metre: real, cells: wp.int32):
        return wp.min(int(distance * per_metre), cells - 1)

    @wp.func
    def tabulated_density(
        z: real, expected: real, sensor: wp.array(dtype=real), cells: wp.int32, per_metre: real, range_max: real
    ):
        column = wp.where(expected >= range_max, cells, range_bin(expected, per_metre, cells))
        return sensor[range_bin(z, per_metre, cells) * (cells + 1) + column]

    return SimpleNamespace(range_bin=range_bin, tabulated_density=tabulated_density)
