"""Shape of the density of a hit, as a function of the normal's exponent t = u^2 / 2 at a distance of u scales."""

import warp as wp

from .error_free import two_product
from .flags import EXACT_EXPONENT, FLOAT64, STUDENT
from .log_terms import log_one_plus
from .prelude import reader
from .types import real, vec2

number_at = reader(real)
TABLE_CELLS = 1024 if FLOAT64 else 256
TABLE_PER_LOG = real(27.0 if FLOAT64 else 16.0)
TABLE_POWERS = 8 if FLOAT64 else 5
ZERO, HALF, ONE = real(0.0), real(0.5), real(1.0)


@wp.func
def shape_exponent(t: vec2, power: real, rate: real):
    """Return the exponent E as a sum of two numbers."""
    if STUDENT:
        more = rate * t.x
        log_more = log_one_plus(more)
        exponent = vec2(power * log_more, ZERO)
        if EXACT_EXPONENT:
            product = two_product(power, log_more)
            exact = two_product(rate, t.x)
            exponent = vec2(product.x, product.y + power * ((exact.y + rate * t.y) / (ONE + more)))
        return exponent
    else:
        return t


@wp.func
def shape_weight(t: real, power: real, rate: real):
    """Return the weight E'(t)."""
    if STUDENT:
        return power * rate / (ONE + rate * t)
    else:
        return ONE


@wp.func
def shape_bend(square: real, power: real):
    """Return ``-u^2 E''(t) / E'(t)`` from ``square = u^2 E'(t)``."""
    if STUDENT:
        return square * (ONE / power)
    else:
        return ZERO


@wp.func
def mass_place(b: real):
    """Return the place of a distance in the table of masses, in cells."""
    return log_one_plus(b) * TABLE_PER_LOG


@wp.func
def mass_at(at: real, masses: wp.array(dtype=real), begin: wp.int32):
    """Return the mass between the mean and a place of the table, which begins at an index of masses."""
    if not at < real(TABLE_CELLS):
        return HALF
    cell = wp.int32(at)
    share = at - real(cell)
    first = begin + cell * TABLE_POWERS
    mass = number_at(masses, first + TABLE_POWERS - 1)
    for i in range(TABLE_POWERS - 1):
        mass = mass * share + number_at(masses, first + TABLE_POWERS - 2 - i)
    return mass


@wp.func
def half_mass(b: real, masses: wp.array(dtype=real), place: wp.int32):
    """Return the mass between the mean and a distance; the table begins at an index of masses."""
    return mass_at(mass_place(b), masses, place)
