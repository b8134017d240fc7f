"""Beam mixture density of one range reading, log p(z | z*), book equations 6.4 to 6.12 without the max atom."""

import math

import warp as wp

from .error_free import pair_sum, rest_of, two_product, two_sum
from .flags import AMCL, BIAS, EXACT_EXPONENT, FLOAT64, GROWTH, HIT, LINEAR, MASS_TABLE, RAND, SHORT, SINGLE
from .hit_shape import half_mass, shape_exponent
from .prelude import field_readers
from .types import MixtureTerms, real, vec2

term_of = field_readers(MixtureTerms)
ZERO, HALF, ONE, TWO = real(0.0), real(0.5), real(1.0), real(2.0)
NEVER = real(-math.inf)
# From here on the error function is 1 to the last bit.
ERF_ONE = real(6.0 if FLOAT64 else 4.0)
# Keep 2 / x and 1 / z* finite.
TINY = real(1e-30)
SMALLEST_RANGE = real(1e-37)


@wp.func
def last_range(z: real, terms: wp.array(dtype=MixtureTerms)):
    """Return the expected range of a reading beyond which log p is constant to the last bit."""
    return wp.max(term_of.last_offset(terms) + term_of.last_slope(terms) * z, term_of.last_least(terms))


@wp.func
def hit_mass(before: real, after: real, erf_scale: real):
    """Return the mass of the untruncated normal from a distance before its mean to one after it."""
    below = before * erf_scale
    above = after * erf_scale
    nearer = wp.min(below, above)
    farther = wp.max(below, above)
    if nearer > ERF_ONE:
        return ONE
    rest = real(1.0)
    if farther <= ERF_ONE:
        rest = wp.erf(farther)
    if nearer > ZERO:
        rest += wp.erf(nearer)
    return HALF * rest


@wp.func
def mass_within(
    mean: real, above: real, scale: real, terms: wp.array(dtype=MixtureTerms), masses: wp.array(dtype=real)
):
    """Return the mass of a hit of any shape on [0, range_max]."""
    if MASS_TABLE:
        place = wp.int32(term_of.mass_table(terms))
        below = half_mass(mean * scale, masses, place)
        return below + half_mass(above * scale, masses, place)
    else:
        return hit_mass(mean, above, scale)


@wp.func
def mean_range(expected: real, terms: wp.array(dtype=MixtureTerms)):
    """Return the mean of p_hit."""
    mean = expected
    if BIAS:
        mean = wp.clamp(expected + term_of.range_bias(terms), ZERO, term_of.range_max(terms))
    return mean


@wp.func
def above_mean(expected: real, terms: wp.array(dtype=MixtureTerms)):
    """Return the distance from the mean of p_hit to range_max, which keeps its digits where it is short."""
    above = term_of.range_max(terms) - expected
    if BIAS:
        last = two_sum(term_of.range_max(terms), -term_of.range_bias(terms))
        above = wp.clamp((last.x - expected) + (last.y - term_of.range_bias_low(terms)), ZERO, term_of.range_max(terms))
    return above


@wp.func
def hit_offset(z: real, expected: real, terms: wp.array(dtype=MixtureTerms)):
    """Return z minus the mean of p_hit as a sum of two numbers; z, z* and the bias nearly cancel."""
    if BIAS:
        mean = mean_range(expected, terms)
        off = vec2(z - mean, ZERO)
        if mean == expected + term_of.range_bias(terms):
            off = pair_sum(two_sum(z, -expected), vec2(-term_of.range_bias(terms), -term_of.range_bias_low(terms)))
        return off
    else:
        return vec2(z - expected, ZERO)


@wp.func
def hit_scale(expected: real, terms: wp.array(dtype=MixtureTerms)):
    """Return sigma_hit / sigma at a range: the first number times (1 + the second)."""
    scale = vec2(ONE, ZERO)
    if GROWTH:
        total = ONE + term_of.relative_growth(terms) * expected
        share = ONE / total
        scale = vec2(share, ZERO)
        if EXACT_EXPONENT:
            # Rounding error of the sum; below 2^24 the sum less 1 is exact.
            excess = (
                rest_of(term_of.relative_growth(terms), expected, total - ONE)
                - term_of.relative_growth_low(terms) * expected
            )
            scale = vec2(share, rest_of(total, share, ONE) + excess * share)
    return scale


@wp.func
def normal_exponent(z: real, expected: real, terms: wp.array(dtype=MixtureTerms)):
    """Return (z - mean)^2 / (2 sigma^2) as a sum of two numbers."""
    off = hit_offset(z, expected, terms)
    if EXACT_EXPONENT:
        if GROWTH:
            scale = hit_scale(expected, terms)
            shortened = off.x * scale.x
            rest = rest_of(off.x, scale.x, shortened)
            off = vec2(shortened, (off.y * scale.x + shortened * scale.y) - rest)
        square = two_product(off.x, off.x)
        if BIAS or GROWTH:
            square = vec2(square.x, square.y + TWO * off.x * off.y)
        product = two_product(square.x, term_of.square_scale(terms))
        return vec2(
            product.x,
            product.y + (square.y * term_of.square_scale(terms) + square.x * term_of.square_scale_low(terms)),
        )
    else:
        scaled = off.x
        if GROWTH:
            scaled = off.x * hit_scale(expected, terms).x
        return vec2(scaled * (scaled * term_of.square_scale(terms)), ZERO)


@wp.func
def hit_exponent(z: real, expected: real, terms: wp.array(dtype=MixtureTerms)):
    """Return the exponent of a hit's density as a sum of two numbers."""
    return shape_exponent(normal_exponent(z, expected, terms), term_of.shape_power(terms), term_of.shape_rate(terms))


@wp.func
def log_hit(z: real, expected: real, terms: wp.array(dtype=MixtureTerms), masses: wp.array(dtype=real)):
    """Return log(z_hit p_hit(z | z*)); terms are in the log domain."""
    exponent = hit_exponent(z, expected, terms)
    scale = hit_scale(expected, terms).x
    log_p = (term_of.hit_peak(terms) - exponent.x) + (term_of.hit_peak_low(terms) - exponent.y)
    if GROWTH:
        log_p += wp.log(scale)
    mass = mass_within(
        mean_range(expected, terms), above_mean(expected, terms), term_of.erf_scale(terms) * scale, terms, masses
    )
    if mass == ONE:
        return log_p
    return log_p - wp.log(mass)


@wp.func
def short_factor(x: real):
    """Return x / (1 - exp(-x)), x >= 0, as h / tanh(h) + h with h = x / 2: exact at 0, without cancellation."""
    h = HALF * x
    if h > TINY:
        return h / wp.tanh(h) + h
    return ONE


@wp.func
def short_peak(rate: real, expected: real):
    """Return short_factor(x) / z* with one division."""
    h = HALF * (rate * expected)
    above = ONE
    below = wp.max(expected, SMALLEST_RANGE)
    if h > TINY:
        t = wp.tanh(h)
        above = rate * (ONE + t)
        below = t + t
    return above / below


@wp.func
def log_short(z: real, expected: real, terms: wp.array(dtype=MixtureTerms)):
    """Return log(z_short p_short(z | z*)); terms are in the log domain."""
    if z <= expected and expected > ZERO:
        return (
            term_of.z_short(terms) + wp.log(short_peak(term_of.lambda_short(terms), expected))
        ) - term_of.lambda_short(terms) * z
    return NEVER


if LINEAR:

    @wp.func
    def log_density(z: real, expected: real, terms: wp.array(dtype=MixtureTerms), masses: wp.array(dtype=real)):
        """Return log p(z | z*); p_rand > 0 bounds the sum from below, so components may underflow."""
        p = real(0.0)
        if HIT:
            # 1: correct range.
            exponent = hit_exponent(z, expected, terms)
            scale = hit_scale(expected, terms).x
            hit = term_of.hit_peak(terms) * scale * wp.exp(-exponent.x) * (ONE - exponent.y)
            mass = mass_within(
                mean_range(expected, terms),
                above_mean(expected, terms),
                term_of.erf_scale(terms) * scale,
                terms,
                masses,
            )
            if mass == ONE:
                p += hit
            else:
                p += hit / mass
        if SHORT:
            # 2: unexpected object.
            if z <= expected and expected > ZERO:
                p += (
                    term_of.z_short(terms)
                    * wp.exp(-term_of.lambda_short(terms) * z)
                    * short_peak(term_of.lambda_short(terms), expected)
                )
        # 4: random measurement.
        return wp.log(p + term_of.rand_density(terms))

else:

    @wp.func
    def log_density(z: real, expected: real, terms: wp.array(dtype=MixtureTerms), masses: wp.array(dtype=real)):
        """Return log p(z | z*)."""
        hit = NEVER
        shorter = NEVER
        largest = NEVER
        if HIT:
            hit = log_hit(z, expected, terms, masses)
            largest = hit
        if SHORT:
            shorter = log_short(z, expected, terms)
            largest = wp.max(largest, shorter)
        if RAND:
            largest = wp.max(largest, term_of.rand_density(terms))
        if SINGLE:
            return largest
        else:
            if wp.isinf(largest):
                return largest
            p = real(0.0)
            if HIT:
                p += wp.exp(hit - largest)  # 1: correct range
            if SHORT:
                p += wp.exp(shorter - largest)  # 2: unexpected object
            if RAND:
                p += wp.exp(term_of.rand_density(terms) - largest)  # 4: random measurement
            return largest + wp.log(p)


@wp.func
def compat_density(z: real, expected: real, terms: wp.array(dtype=MixtureTerms)):
    """Return the density whose cube nav2_amcl and Beluga add for each beam of a scan."""
    off = z - expected
    p = terms[0].hit_peak * wp.exp(-(off * (off * terms[0].square_scale)))
    if AMCL:
        if z < expected:
            p += terms[0].z_short * terms[0].lambda_short * wp.exp(-terms[0].lambda_short * z)
        if z > terms[0].range_max:
            return p
    else:
        p /= hit_mass(expected, terms[0].range_max - expected, terms[0].erf_scale)
        if z < expected:
            p += (
                terms[0].z_short
                * short_factor(terms[0].lambda_short * expected)
                * wp.exp(-terms[0].lambda_short * z)
                / expected
            )
    if z >= terms[0].range_max:
        p += terms[0].z_max
    else:
        p += terms[0].rand_density
    return p
