"""Readings drawn from the beam model, or from a table of a sensor, given their expected ranges."""

import math

import warp as wp

from gpusense.interface import constants as c
from gpusense.interface import formulas

from .elementary import exp_of, log_of
from .flags import INCIDENCE, MASS_TABLE, SENSOR_TABLE
from .philox import random_words
from .prelude import doubles, kernel
from .sensor_table import range_bin
from .types import real

READING_STREAM = wp.uint32(c.READING_STREAM)
ZERO, HALF, ONE, TWO, THREE, SIX = (wp.float64(value) for value in (0.0, 0.5, 1.0, 2.0, 3.0, 6.0))
MINUS_HALF, INFINITE, NOWHERE = wp.float64(-0.5), wp.float64(math.inf), wp.float64(math.nan)
WORD_SHIFT = wp.uint32(12)
f = doubles(formulas)
DRAW_CELLS, DRAW_POWERS = 1024, 8
DRAW_PER_LOG, DRAW_LAST = wp.float64(27.0), wp.float64(1023.0)
factors_8 = wp.types.vector(length=8, dtype=wp.float64)


@wp.func
def fine_uniform(high: wp.uint32, low: wp.uint32):
    """Return numbers in (0, 1) from two words, the centres of 2^52 intervals."""
    return ((wp.float64(high) * f.HALF_WORD + wp.float64(low >> WORD_SHIFT)) + HALF) * f.FINE


@wp.func
def half_mass(x: wp.float64):
    """Return the mass of the standard normal between 0 and x >= 0."""
    if x >= f.HALF_FROM:
        return HALF
    if x >= f.SERIES_END:
        fraction = wp.float64(x)
        for i in range(f.FRACTION_TERMS):
            fraction = x + wp.float64(f.FRACTION_TERMS - i) / fraction
        return HALF - f.NORMAL_PEAK * exp_of(MINUS_HALF * x * x) / fraction
    square = x * x
    term = wp.float64(1.0)
    total = wp.float64(1.0)
    for n in range(1, f.SERIES_TERMS):
        term = term * (square / (TWO * wp.float64(n) + ONE))
        total = total + term
    return x * (f.NORMAL_PEAK * exp_of(MINUS_HALF * square)) * total


@wp.func
def polynomial(factor: factors_8, x: wp.float64):
    """Return a polynomial by Horner's rule, the highest power first."""
    value = factor[0]
    for i in range(1, 8):
        value = value * x + factor[i]
    return value


@wp.func
def half_quantile(mass: wp.float64):
    """Return the x >= 0 with a mass of the standard normal between 0 and x, from 0 to MOST_HALF."""
    if mass <= f.CENTRAL:
        r = f.CENTRAL_OFFSET - mass * mass
        return mass * (polynomial(f.CENTRAL_OVER, r) / polynomial(f.CENTRAL_UNDER, r))
    root = wp.sqrt(-log_of(HALF - mass))
    if root <= f.CENTRAL_END:
        outer = root - f.OUTER_OFFSET
        return polynomial(f.OUTER_OVER, outer) / polynomial(f.OUTER_UNDER, outer)
    outermost = root - f.OUTERMOST_OFFSET
    return polynomial(f.OUTERMOST_OVER, outermost) / polynomial(f.OUTERMOST_UNDER, outermost)


@wp.func
def normal_within(u: wp.float64, low: wp.float64, high: wp.float64):
    """Return a standard normal deviate between -low <= 0 and high >= 0."""
    below = half_mass(low)
    above = half_mass(high)
    mark = u * (below + above) - below
    size = half_quantile(wp.min(wp.abs(mark), f.MOST_HALF))
    return wp.min(wp.max(wp.where(mark < ZERO, -size, size), -low), high)


@wp.func
def tabulated(at: wp.float64, tables: wp.array(dtype=wp.float64), place: wp.int32):
    """Return the number of a table that begins at a place, at a logarithmic coordinate."""
    steps = at * DRAW_PER_LOG
    cell = wp.int32(wp.min(steps, DRAW_LAST))
    share = steps - wp.float64(cell)
    first = place + cell * DRAW_POWERS
    value = tables[first + DRAW_POWERS - 1]
    for i in range(DRAW_POWERS - 1):
        value = value * share + tables[first + DRAW_POWERS - 2 - i]
    return value


@wp.func
def table_mass(u: wp.float64, tables: wp.array(dtype=wp.float64), place: wp.int32):
    """Return the mass of a hit between its mean and a distance of u scales, from its table."""
    return wp.min(tabulated(log_of(ONE + wp.min(u, f.FARTHEST_HIT) * f.SQRT_HALF), tables, place), HALF)


@wp.func
def table_within(u: wp.float64, low: wp.float64, high: wp.float64, tables: wp.array(dtype=wp.float64), place: wp.int32):
    """Return a deviate of a hit between -low <= 0 and high >= 0, from its tables."""
    below = table_mass(low, tables, place)
    above = table_mass(high, tables, place)
    mark = u * (below + above) - below
    level = -log_of(ONE - TWO * wp.min(wp.abs(mark), f.MOST_HALF))
    size = (exp_of(tabulated(level, tables, place + DRAW_CELLS * DRAW_POWERS)) - ONE) / f.SQRT_HALF
    return wp.min(wp.max(wp.where(mark < ZERO, -size, size), -low), high)


@wp.func
def short_of(u: wp.float64, expected: wp.float64, decay: wp.float64):
    """Return a range drawn from p_short, up to the expected range (> 0)."""
    x = decay * expected
    if x < f.SHORT_SERIES:
        square = u * u
        bend = (u / SIX - square / TWO) + square * u / THREE
        return wp.min(expected * (u + x * ((square - u) / TWO + x * bend)), expected)
    return wp.min(-log_of((ONE - u) + u * exp_of(-x)) / decay, expected)


@wp.func
def reading_of(
    u: wp.float64, v: wp.float64, expected: wp.float64, mixture: wp.array(dtype=wp.float64), bins: wp.int32,
    range_max: wp.float64,
):  # fmt: skip
    """Return a reading drawn from the mixture; infinity without return, NaN where no reading is possible."""
    p = c.DRAW_TERMS * bins
    first = mixture[p]
    second = first + wp.where(expected > ZERO, mixture[p + 1], ZERO)
    third = second + mixture[p + 2]
    total = third + mixture[p + 3]
    mark = u * total
    if not total > ZERO:
        return NOWHERE
    if mark < first:
        mean = wp.min(wp.max(expected + mixture[p + 6], ZERO), range_max)
        spread = mixture[p + 4] + mixture[p + 5] * expected
        low = mean / spread
        high = (range_max - mean) / spread
        if MASS_TABLE:
            return wp.max(mean + spread * table_within(v, low, high, mixture, wp.int32(mixture[p + 8])), ZERO)
        else:
            return wp.max(mean + spread * normal_within(v, low, high), ZERO)
    if mark < second:
        return short_of(v, expected, mixture[p + 7])
    return wp.where(mark < third, INFINITE, v * range_max)


@wp.func
def cell_reading_of(
    u: wp.float64, v: wp.float64, column: wp.int32, chances: wp.array(dtype=wp.float64), cells: wp.int32,
    range_max: wp.float64, margin: wp.float64,
):  # fmt: skip
    """Return a reading drawn from a table: uniform in a drawn bin, at a margin from the bin's ends."""
    row = column * (cells + 1)
    mark = u * chances[row + cells]
    low = int(0)
    high = wp.int32(cells)
    while low < high:
        middle = (low + high) // 2
        if chances[row + middle] > mark:
            high = middle
        else:
            low = middle + 1
    if low == cells:
        return INFINITE
    return (wp.float64(low) + (margin + v * (ONE - TWO * margin))) * (range_max / wp.float64(cells))


@kernel
def draw_readings(incidence, mixture, edges, chances, settings, ranges, particles, rays, tables, scale):
    """Replace expected ranges by readings; one work-item takes a particle and ray."""
    i, k = wp.tid()
    if k >= rays or i >= particles:
        return
    place = i * rays + k
    n = wp.int64(settings[c.DRAW_FIRST]) + wp.int64(i)
    each = wp.int64(settings[c.DRAW_PER_SCAN])
    step = wp.uint32(n / each) + wp.uint32(settings[c.DRAW_STEP])
    words = random_words(
        wp.uint32(n % each), step, READING_STREAM + wp.uint32(k), wp.uint32(settings[c.DRAW_SEED]),
        wp.uint32(settings[c.DRAW_SEED + 1]),
    )  # fmt: skip
    u = fine_uniform(words[0], words[1])
    v = fine_uniform(words[2], words[3])
    limit = settings[c.DRAW_RANGE_MAX]
    drawn = wp.float64(0.0)
    if SENSOR_TABLE:
        column = range_bin(ranges[place], tables.per_metre, tables.cells, scale.range_max)
        drawn = cell_reading_of(u, v, column, chances, tables.cells, limit, settings[c.DRAW_MARGIN])
    else:
        bins = int(0)
        if INCIDENCE:
            while bins + 1 < tables.incidence_bins and incidence[place] <= edges[bins]:
                bins += 1
        drawn = reading_of(u, v, wp.min(wp.float64(ranges[place]), limit), mixture, bins, limit)
    if wp.isinf(drawn):
        ranges[place] = scale.range_max
    elif wp.isnan(drawn):
        ranges[place] = real(drawn)
    else:
        ranges[place] = real(wp.min(drawn, settings[c.DRAW_TOP]))
