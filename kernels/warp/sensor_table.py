"""Density of one reading from a table of log p over bins of readings and expected ranges."""

import warp as wp

from .types import MixtureTables, real


@wp.func
def range_bin(distance: real, per_metre: real, cells: wp.int32, range_max: real):
    """Return the bin of a range; the last one, after the cells, is for range_max and more."""
    if distance >= range_max:
        return cells
    return wp.min(int(distance * per_metre), cells - 1)


@wp.func
def tabulated_density(z: real, expected: real, sensor: wp.array(dtype=real), tables: MixtureTables, range_max: real):
    """Return log p of a reading for an expected range."""
    column = range_bin(expected, tables.per_metre, tables.cells, range_max)
    return sensor[range_bin(z, tables.per_metre, tables.cells, range_max) * (tables.cells + 1) + column]
