"""Readings drawn from the beam model, or from a table of a sensor, given their expected ranges.

Thrun, Burgard and Fox, *Probabilistic Robotics* (2005), section 6.3.1: a component is drawn by its weight, and a
reading by inverting the component's distribution function. For p_hit it is the normal on both sides of its mean, each
with its mass on [0, range_max]. Masses are sums of positive terms: x phi(x) (1 + x^2 / 3 + x^4 / 15 + ...), and beyond
SERIES_END one half less the continued fraction of Laplace. Quantiles: Wichura, *Algorithm AS 241* (1988). For p_short
it is 1 - u (1 - exp(-lambda z*)), written as a sum of positive terms, or as a series where lambda z* is small.
Everything is computed in float64 by +, -, *, / and sqrt, so that every device draws the same bits.

Other shapes of hits than the normal (MASS_TABLE) have a table of masses and a table of quantiles: cells of equal width
in log(1 + b), b = u / sqrt 2, and in -log(1 - 2 mass), with the coefficients of a polynomial in the position within the
cell.

``mixture`` = (z_hit, z_short, z_max, z_rand, sigma_hit, sigma_growth, range_bias, lambda_short, place of the tables) of
each bin of angles of incidence, and then the tables. ``chances`` = for each bin of expected ranges, the cumulative
probabilities of the bins of readings.
"""

import math

import warp as wp

from .elementary import exp_of, log_of
from .flags import INCIDENCE, MASS_TABLE, SENSOR_TABLE
from .philox import random_words
from .prelude import kernel
from .sensor_table import range_bin
from .types import real

READING_STREAM = wp.constant(wp.uint32(1 << 30))
DRAW_TERMS = wp.constant(9)
# Numbers of the settings by place; DRAW_SEED takes 2.
DRAW_SEED, DRAW_STEP, DRAW_FIRST, DRAW_PER_SCAN, DRAW_RANGE_MAX, DRAW_TOP, DRAW_MARGIN = (
    wp.constant(place) for place in (0, 2, 3, 4, 5, 6, 7)
)
ZERO, HALF, ONE, TWO, THREE, SIX = (wp.constant(wp.float64(value)) for value in (0.0, 0.5, 1.0, 2.0, 3.0, 6.0))
MINUS_HALF, INFINITE, NOWHERE = (
    wp.constant(wp.float64(-0.5)),
    wp.constant(wp.float64(math.inf)),
    wp.constant(wp.float64(math.nan)),
)
# 2^20 and 2^-52.
HALF_WORD, FINE, WORD_SHIFT = (
    wp.constant(wp.float64(1048576.0)),
    wp.constant(wp.float64(2.220446049250313e-16)),
    wp.constant(wp.uint32(12)),
)
# 1 / sqrt(2 pi); the largest number below one half.
NORMAL_PEAK, MOST_HALF = wp.constant(wp.float64(0.3989422804014327)), wp.constant(wp.float64(0.49999999999999994))
# Tables of shapes; beyond FARTHEST_HIT scales the mass is one half.
DRAW_CELLS, DRAW_POWERS = wp.constant(1024), wp.constant(8)
DRAW_PER_LOG, DRAW_LAST = wp.constant(wp.float64(27.0)), wp.constant(wp.float64(1023.0))
FARTHEST_HIT, SQRT_HALF = wp.constant(wp.float64(1e16)), wp.constant(wp.float64(0.7071067811865476))
# Change from the series of the mass to the continued fraction; median.
SERIES_END, HALF_FROM = wp.constant(wp.float64(4.0)), wp.constant(wp.float64(9.0))
SERIES_TERMS, FRACTION_TERMS = wp.constant(48), wp.constant(24)
# AS 241: quantiles of central, outer and outermost probabilities, the highest power first.
CENTRAL, CENTRAL_END, CENTRAL_OFFSET = (
    wp.constant(wp.float64(0.425)),
    wp.constant(wp.float64(5.0)),
    wp.constant(wp.float64(0.180625)),
)
OUTER_OFFSET, OUTERMOST_OFFSET = wp.constant(wp.float64(1.6)), wp.constant(wp.float64(5.0))
factors_8 = wp.types.vector(length=8, dtype=wp.float64)
# fmt: off
CENTRAL_OVER = wp.constant(factors_8(
    2509.0809287301227, 33430.57558358813, 67265.7709270087, 45921.95393154987, 13731.69376550946, 1971.5909503065513,
    133.14166789178438, 3.3871328727963665,
))
CENTRAL_UNDER = wp.constant(factors_8(
    5226.495278852854, 28729.085735721943, 39307.89580009271, 21213.794301586597, 5394.196021424751, 687.1870074920579,
    42.31333070160091, 1.0,
))
OUTER_OVER = wp.constant(factors_8(
    0.0007745450142783414, 0.022723844989269184, 0.2417807251774506, 1.2704582524523684, 3.6478483247632045,
    5.769497221460691, 4.630337846156546, 1.4234371107496835,
))
OUTER_UNDER = wp.constant(factors_8(
    1.0507500716444169e-09, 0.0005475938084995345, 0.015198666563616457, 0.14810397642748008, 0.6897673349851,
    1.6763848301838038, 2.053191626637759, 1.0,
))
OUTERMOST_OVER = wp.constant(factors_8(
    2.0103343992922881e-07, 2.7115555687434876e-05, 0.0012426609473880784, 0.026532189526576124, 0.29656057182850487,
    1.7848265399172913, 5.463784911164114, 6.657904643501103,
))
OUTERMOST_UNDER = wp.constant(factors_8(
    2.0442631033899397e-15, 1.421511758316446e-07, 1.8463183175100548e-05, 0.0007868691311456133, 0.014875361290850615,
    0.1369298809227358, 0.599832206555888, 1.0,
))
# fmt: on
# Below this lambda z* the distribution of p_short is a series.
SHORT_SERIES = wp.constant(wp.float64(1e-4))


@wp.func
def fine_uniform(high: wp.uint32, low: wp.uint32):
    """Return numbers in (0, 1) from two words, the centres of 2^52 intervals."""
    return ((wp.float64(high) * HALF_WORD + wp.float64(low >> WORD_SHIFT)) + HALF) * FINE


@wp.func
def half_mass(x: wp.float64):
    """Return the mass of the standard normal between 0 and x >= 0."""
    if x >= HALF_FROM:
        return HALF
    if x >= SERIES_END:
        fraction = wp.float64(x)
        for i in range(FRACTION_TERMS):
            fraction = x + wp.float64(FRACTION_TERMS - i) / fraction
        return HALF - NORMAL_PEAK * exp_of(MINUS_HALF * x * x) / fraction
    square = x * x
    term = wp.float64(1.0)
    total = wp.float64(1.0)
    for n in range(1, SERIES_TERMS):
        term = term * (square / (TWO * wp.float64(n) + ONE))
        total = total + term
    return x * (NORMAL_PEAK * exp_of(MINUS_HALF * square)) * total


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
    if mass <= CENTRAL:
        r = CENTRAL_OFFSET - mass * mass
        return mass * (polynomial(CENTRAL_OVER, r) / polynomial(CENTRAL_UNDER, r))
    root = wp.sqrt(-log_of(HALF - mass))
    if root <= CENTRAL_END:
        outer = root - OUTER_OFFSET
        return polynomial(OUTER_OVER, outer) / polynomial(OUTER_UNDER, outer)
    outermost = root - OUTERMOST_OFFSET
    return polynomial(OUTERMOST_OVER, outermost) / polynomial(OUTERMOST_UNDER, outermost)


@wp.func
def normal_within(u: wp.float64, low: wp.float64, high: wp.float64):
    """Return a standard normal deviate between -low <= 0 and high >= 0."""
    below = half_mass(low)
    above = half_mass(high)
    mark = u * (below + above) - below
    size = half_quantile(wp.min(wp.abs(mark), MOST_HALF))
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
    return wp.min(tabulated(log_of(ONE + wp.min(u, FARTHEST_HIT) * SQRT_HALF), tables, place), HALF)


@wp.func
def table_within(u: wp.float64, low: wp.float64, high: wp.float64, tables: wp.array(dtype=wp.float64), place: wp.int32):
    """Return a deviate of a hit between -low <= 0 and high >= 0, from its tables."""
    below = table_mass(low, tables, place)
    above = table_mass(high, tables, place)
    mark = u * (below + above) - below
    level = -log_of(ONE - TWO * wp.min(wp.abs(mark), MOST_HALF))
    size = (exp_of(tabulated(level, tables, place + DRAW_CELLS * DRAW_POWERS)) - ONE) / SQRT_HALF
    return wp.min(wp.max(wp.where(mark < ZERO, -size, size), -low), high)


@wp.func
def short_of(u: wp.float64, expected: wp.float64, decay: wp.float64):
    """Return a range drawn from p_short, up to the expected range (> 0)."""
    x = decay * expected
    if x < SHORT_SERIES:
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
    p = DRAW_TERMS * bins
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
    n = wp.int64(settings[DRAW_FIRST]) + wp.int64(i)
    each = wp.int64(settings[DRAW_PER_SCAN])
    step = wp.uint32(n / each) + wp.uint32(settings[DRAW_STEP])
    words = random_words(
        wp.uint32(n % each), step, READING_STREAM + wp.uint32(k), wp.uint32(settings[DRAW_SEED]),
        wp.uint32(settings[DRAW_SEED + 1]),
    )  # fmt: skip
    u = fine_uniform(words[0], words[1])
    v = fine_uniform(words[2], words[3])
    limit = settings[DRAW_RANGE_MAX]
    drawn = wp.float64(0.0)
    if SENSOR_TABLE:
        column = range_bin(ranges[place], tables.per_metre, tables.cells, scale.range_max)
        drawn = cell_reading_of(u, v, column, chances, tables.cells, limit, settings[DRAW_MARGIN])
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
        ranges[place] = real(wp.min(drawn, settings[DRAW_TOP]))
