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

from __future__ import annotations

import numpy as np

from gpusense.interface import constants as c
from gpusense.interface import formulas as f
from gpusense.reference.elementary import exp_of, log_of
from gpusense.reference.philox import random_words
from gpusense.reference.sensor_table import range_bin

BLOCK = 1 << 18
DRAW_CELLS, DRAW_PER_LOG, DRAW_POWERS = c.TABLE_CELLS[8], c.TABLE_PER_LOG[8], c.TABLE_POWERS[8]


def fine_uniform(high: np.ndarray, low: np.ndarray) -> np.ndarray:
    """Return numbers in (0, 1) from two words, the centres of 2^52 intervals."""
    whole = high.astype(np.float64) * f.HALF_WORD + (low >> np.uint64(12)).astype(np.float64)
    return (whole + 0.5) * f.FINE


def half_mass(x: np.ndarray) -> np.ndarray:
    """Return the mass of the standard normal between 0 and x >= 0."""
    near = np.minimum(x, f.SERIES_END)
    square = near * near
    term, total = np.ones_like(x), np.ones_like(x)
    for n in range(1, f.SERIES_TERMS):
        term = term * (square / (2.0 * n + 1.0))
        total = total + term
    series = near * (f.NORMAL_PEAK * exp_of(-0.5 * square)) * total
    far = np.clip(x, f.SERIES_END, f.HALF_FROM)
    fraction = far
    for n in range(f.FRACTION_TERMS, 0, -1):
        fraction = far + n / fraction
    tail = f.NORMAL_PEAK * exp_of(-0.5 * far * far) / fraction
    return np.where(x < f.SERIES_END, series, np.where(x < f.HALF_FROM, 0.5 - tail, 0.5))


def polynomial(factors: list[float], x: np.ndarray) -> np.ndarray:
    """Return a polynomial by Horner's rule, the highest power first."""
    value = np.full_like(x, factors[0])
    for factor in factors[1:]:
        value = value * x + factor
    return value


def half_quantile(mass: np.ndarray) -> np.ndarray:
    """Return the x >= 0 with a mass of the standard normal between 0 and x, from 0 to MOST_HALF."""
    r = f.CENTRAL_OFFSET - mass * mass
    central = mass * (polynomial(f.CENTRAL_OVER, r) / polynomial(f.CENTRAL_UNDER, r))
    root = np.sqrt(-log_of(0.5 - mass))
    r = root - f.OUTER_OFFSET
    outer = polynomial(f.OUTER_OVER, r) / polynomial(f.OUTER_UNDER, r)
    r = root - f.OUTERMOST_OFFSET
    outermost = polynomial(f.OUTERMOST_OVER, r) / polynomial(f.OUTERMOST_UNDER, r)
    return np.where(mass <= f.CENTRAL, central, np.where(root <= f.CENTRAL_END, outer, outermost))


def normal_within(u: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return a standard normal deviate between -low <= 0 and high >= 0."""
    below, above = half_mass(low), half_mass(high)
    mark = u * (below + above) - below
    size = half_quantile(np.minimum(np.abs(mark), f.MOST_HALF))
    return np.minimum(np.maximum(np.where(mark < 0.0, -size, size), -low), high)


def tabulated(at: np.ndarray, tables: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Return the numbers of tables that begin at places, at logarithmic coordinates."""
    steps = at * DRAW_PER_LOG
    cell = np.minimum(steps, DRAW_CELLS - 1.0).astype(np.int64)
    share = steps - cell.astype(np.float64)
    first = place.astype(np.int64) + cell * DRAW_POWERS
    value = tables[first + (DRAW_POWERS - 1)]
    for i in range(DRAW_POWERS - 2, -1, -1):
        value = value * share + tables[first + i]
    return value


def table_mass(u: np.ndarray, tables: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Return the mass of a hit between its mean and a distance of u scales, from its table."""
    at = log_of(1.0 + np.minimum(u, f.FARTHEST_HIT) * f.SQRT_HALF)
    return np.minimum(tabulated(at, tables, place), 0.5)


def table_within(u: np.ndarray, low: np.ndarray, high: np.ndarray, tables: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Return a deviate of a hit between -low <= 0 and high >= 0, from its tables."""
    below, above = table_mass(low, tables, place), table_mass(high, tables, place)
    mark = u * (below + above) - below
    level = -log_of(1.0 - 2.0 * np.minimum(np.abs(mark), f.MOST_HALF))
    size = (exp_of(tabulated(level, tables, place + DRAW_CELLS * DRAW_POWERS)) - 1.0) / f.SQRT_HALF
    return np.minimum(np.maximum(np.where(mark < 0.0, -size, size), -low), high)


def short_of(u: np.ndarray, expected: np.ndarray, decay: np.ndarray) -> np.ndarray:
    """Return a range drawn from p_short, up to the expected range (> 0)."""
    x = decay * expected
    square = u * u
    bend = (u / 6.0 - square / 2.0) + square * u / 3.0
    series = expected * (u + x * ((square - u) / 2.0 + x * bend))
    left = (1.0 - u) + u * exp_of(-x)
    drawn = np.where(x < f.SHORT_SERIES, series, -log_of(left) / np.where(decay > 0.0, decay, 1.0))
    return np.minimum(drawn, expected)


def reading_of(flags, u, v, expected, mixture, bins, range_max):
    """Return readings of the mixture for expected ranges; infinity without return, NaN where none is possible.

    ``u``, ``v``: numbers in (0, 1) that choose the component and the reading; ``mixture``: see above.
    """
    terms = (mixture[c.DRAW_TERMS * bins + i] for i in range(c.DRAW_TERMS))
    hit, short, none, rand, sigma, growth, bias, decay, place = terms
    short = np.where(expected > 0.0, short, 0.0)
    first, second = hit, hit + short
    third = second + none
    total = third + rand
    mark = u * total
    mean = np.minimum(np.maximum(expected + bias, 0.0), range_max)
    spread = sigma + growth * expected
    with np.errstate(over="ignore"):
        low, high = mean / spread, (range_max - mean) / spread
    if "MASS_TABLE" in flags:
        deviate = table_within(v, low, high, mixture, place)
    else:
        deviate = normal_within(v, low, high)
    drawn_hit = mean + spread * deviate
    drawn = np.where(mark < third, np.inf, v * range_max)
    drawn = np.where(mark < second, short_of(v, expected, decay), drawn)
    drawn = np.where(mark < first, np.maximum(drawn_hit, 0.0), drawn)
    return np.where(total > 0.0, drawn, np.nan)


def cell_reading_of(
    u: np.ndarray, v: np.ndarray, column: np.ndarray, chances: np.ndarray, cells: int, range_max: float, margin: float
) -> np.ndarray:
    """Return readings drawn from a table: uniform in a drawn bin, at a margin from the bin's ends."""
    table = chances.reshape(cells + 1, cells + 1)
    mark = u * table[column, cells]
    low, high = np.zeros(len(u), np.int64), np.full(len(u), cells)
    while (low < high).any():
        middle = (low + high) // 2
        above = table[column, middle] > mark
        low, high = np.where(above | (low >= high), low, middle + 1), np.where(above & (low < high), middle, high)
    return np.where(low == cells, np.inf, (low + (margin + v * (1.0 - 2.0 * margin))) * (range_max / cells))


def draw_readings(flags, incidence, mixture, edges, chances, settings, ranges, particles, rays, tables, scale):
    """Replace expected ranges by readings; ``incidence`` holds cosines, and ``edges`` the cosines between bins."""
    count, limit, top = particles * rays, settings[c.DRAW_RANGE_MAX], settings[c.DRAW_TOP]
    for begin in range(0, count, BLOCK):
        part = slice(begin, min(begin + BLOCK, count))
        place = np.arange(part.start, part.stop)
        n, stream = int(settings[c.DRAW_FIRST]) + place // rays, c.READING_STREAM + place % rays
        scan, particle = np.divmod(n, int(settings[c.DRAW_PER_SCAN]))
        counter = particle, scan + int(settings[c.DRAW_STEP]), stream, np.zeros_like(n)
        words = random_words(counter, int(settings[c.DRAW_SEED]), int(settings[c.DRAW_SEED + 1]))
        u, v = fine_uniform(words[0], words[1]), fine_uniform(words[2], words[3])
        z = ranges[part]
        if "SENSOR_TABLE" in flags:
            column = range_bin(z, tables.per_metre, tables.cells, scale.range_max)
            drawn = cell_reading_of(u, v, column, chances, tables.cells, limit, settings[c.DRAW_MARGIN])
        else:
            bins = np.zeros(len(n), np.int64)
            if "INCIDENCE" in flags:
                bins = (incidence[part, None] <= edges[: tables.incidence_bins - 1]).sum(axis=1)
            expected = np.minimum(z.astype(np.float64), limit)
            drawn = reading_of(flags, u, v, expected, mixture, bins, limit)
        ranges[part] = np.where(np.isinf(drawn), scale.range_max, np.minimum(drawn, top)).astype(ranges.dtype)
