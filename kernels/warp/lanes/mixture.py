"""Beam mixture density of a block of readings in float32: mixture.py in loops that become vectors of 16 readings."""

import math

import warp as wp

from gpusense.interface.constants import BLOCK_TERMS

from ..error_free import pair_sum, rest_of, two_product, two_sum
from ..flags import (
    ALL_READINGS,
    AMCL,
    BIAS,
    CUBES,
    EXACT_EXPONENT,
    GROWTH,
    HIT,
    LINEAR,
    MASS_TABLE,
    RAND,
    SHORT,
    SINGLE,
)
from ..hit_shape import mass_at, mass_place, shape_exponent
from ..mixture import above_mean, hit_scale, mean_range
from ..prelude import apart, field_readers, reader
from ..types import MixtureTerms, real, vec2
from .math import erf_lanes, exp_lanes, log_lanes, one_minus_exp_lanes

block_numbers = wp.types.vector(length=BLOCK_TERMS, dtype=real)
block_bins = wp.types.vector(length=BLOCK_TERMS, dtype=wp.int32)
at, term_of = reader(real), field_readers(MixtureTerms)
HIT_OR_SHORT = HIT and SHORT and not RAND
SCALED = LINEAR or CUBES
SHIFTED = BIAS or GROWTH
WITH_HITS = HIT or CUBES
ZERO, HALF, ONE, TWO = real(0.0), real(0.5), real(1.0), real(2.0)
NEVER = real(-math.inf)
ERF_ONE = real(4.0)
SMALLEST_RANGE = real(1e-37)
# Up to this 1 - exp(-x) is x within a quarter of the last bit.
SMALL_DECAY = real(2.98023224e-08)


@wp.func
def normal_exponent_lanes(z: real, expected: real, scale: vec2, terms: wp.array(dtype=MixtureTerms)):
    """Return (z - mean)^2 / (2 sigma^2) as a sum of two numbers."""
    off = z - expected
    off_low = real(0.0)
    if BIAS:
        # z, z* and the bias nearly cancel.
        bias = term_of.range_bias(terms)
        exact_off = pair_sum(two_sum(z, -expected), vec2(-bias, -term_of.range_bias_low(terms)))
        mean = mean_range(expected, terms)
        inside = mean == expected + bias
        off = wp.where(inside, exact_off.x, z - mean)
        off_low = wp.where(inside, exact_off.y, ZERO)
    if EXACT_EXPONENT:
        if GROWTH:
            scaled = off * scale.x
            off_low = (off_low * scale.x + scaled * scale.y) - rest_of(off, scale.x, scaled)
            off = scaled
        square = two_product(off, off)
        square_low = square.y
        if SHIFTED:
            square_low += TWO * off * off_low
        peak = term_of.square_scale(terms)
        product = two_product(square.x, peak)
        return vec2(product.x, product.y + (square_low * peak + square.x * term_of.square_scale_low(terms)))
    else:
        if GROWTH:
            off = off * scale.x
        return vec2(off * (off * term_of.square_scale(terms)), ZERO)


@wp.func
def hit_exponent_lanes(z: real, expected: real, scale: vec2, terms: wp.array(dtype=MixtureTerms)):
    """Return the exponent of a hit's density as a sum of two numbers."""
    normal = normal_exponent_lanes(z, expected, scale, terms)
    return shape_exponent(normal, term_of.shape_power(terms), term_of.shape_rate(terms))


@wp.func
def near_an_end(mean: real, above: real, scale: real):
    """Return whether the mass of a hit on [0, range_max] may be less than 1."""
    if MASS_TABLE:
        return int(1)
    else:
        return int(wp.min(mean, above) * scale < ERF_ONE)


@wp.func
def masses_within(expected: block_numbers, terms: wp.array(dtype=MixtureTerms), masses: wp.array(dtype=real)):
    """Return the masses of hits of any shape on [0, range_max]. Look-ups in a table keep a loop scalar."""
    inside, far = block_numbers(), block_numbers()
    i = int(0)
    while i < BLOCK_TERMS:
        mean = mean_range(expected[i], terms)
        scale = term_of.erf_scale(terms) * hit_scale(expected[i], terms).x
        below = mean * scale
        above = above_mean(expected[i], terms) * scale
        if MASS_TABLE:
            inside[i] = mass_place(below)
            far[i] = mass_place(above)
        else:
            inside[i] = HALF * (erf_lanes(below) + erf_lanes(above))
        i += 1
    if MASS_TABLE:
        i = int(0)
        while i < BLOCK_TERMS:
            place = wp.int32(term_of.mass_table(terms))
            inside[i] = mass_at(inside[i], masses, place) + mass_at(far[i], masses, place)
            i += 1
    return inside


@wp.func
def short_length_lanes(expected: real, terms: wp.array(dtype=MixtureTerms)):
    """Return (1 - exp(-lambda z*)) / lambda, the length that divides p_short."""
    decay = term_of.lambda_short(terms)
    x = decay * expected
    length = wp.where(x > SMALL_DECAY, one_minus_exp_lanes(-x) * (ONE / decay), expected)
    return wp.max(length, SMALLEST_RANGE)


@wp.func
def hit_density_lanes(z: real, expected: real, terms: wp.array(dtype=MixtureTerms)):
    """Return the density of a hit before its division by its mass, or its logarithm."""
    scale = hit_scale(expected, terms)
    exponent = hit_exponent_lanes(z, expected, scale, terms)
    if LINEAR:
        hit = term_of.hit_peak(terms) * exp_lanes(-exponent.x)
        if GROWTH:
            hit = hit * scale.x
        if EXACT_EXPONENT:
            # The second part is arbitrary where the density underflows.
            hit = wp.where(hit > ZERO, hit * (ONE - exponent.y), hit)
        return hit
    else:
        log_hit = (term_of.hit_peak(terms) - exponent.x) + (term_of.hit_peak_low(terms) - exponent.y)
        if GROWTH:
            log_hit += log_lanes(scale.x)
        return log_hit


@wp.func
def short_density_lanes(z: real, expected: real, terms: wp.array(dtype=MixtureTerms)):
    """Return the density of a short reading, or its logarithm."""
    length = short_length_lanes(expected, terms)
    decay = term_of.lambda_short(terms)
    inside = z <= expected and expected > ZERO
    if LINEAR:
        return wp.where(inside, term_of.z_short(terms) * exp_lanes(-decay * z) / length, ZERO)
    else:
        return wp.where(inside, (term_of.z_short(terms) - log_lanes(length)) - decay * z, NEVER)


@wp.func
def log_of_parts_lanes(hit: real, shorter: real, terms: wp.array(dtype=MixtureTerms)):
    """Return log p(z | z*) from the densities of components, or from their logarithms."""
    random = term_of.rand_density(terms)
    if LINEAR:
        return log_lanes((random + hit) + shorter)
    else:
        largest = wp.max(shorter, hit)
        if RAND:
            largest = wp.max(random, largest)
        if SINGLE:
            return largest
        else:
            # The larger component counts as 1.
            p = real(1.0)
            if RAND:
                p = exp_lanes(random - largest)
                if HIT:
                    p += exp_lanes(hit - largest)
                if SHORT:
                    p += exp_lanes(shorter - largest)
            elif HIT_OR_SHORT:
                p += exp_lanes(wp.min(hit, shorter) - largest)
            return wp.where(largest == NEVER, largest, largest + log_lanes(p))


@wp.func
def compat_density_lanes(z: real, expected: real, hit: real, terms: wp.array(dtype=MixtureTerms)):
    """Return the density to be cubed, without a division by its hit's mass: compat_density of py."""
    p = hit
    if AMCL:
        p += wp.where(
            z < expected,
            term_of.z_short(terms) * term_of.lambda_short(terms) * exp_lanes(-term_of.lambda_short(terms) * z),
            ZERO,
        )
        return wp.where(
            z > term_of.range_max(terms),
            p,
            p + wp.where(z >= term_of.range_max(terms), term_of.z_max(terms), term_of.rand_density(terms)),
        )
    else:
        length = short_length_lanes(expected, terms)
        p += wp.where(z < expected, term_of.z_short(terms) * exp_lanes(-term_of.lambda_short(terms) * z) / length, ZERO)
        return p + wp.where(z >= term_of.range_max(terms), term_of.z_max(terms), term_of.rand_density(terms))


@apart
def block_terms(
    z: block_numbers,
    expected: block_numbers,
    terms: wp.array(dtype=MixtureTerms),
    masses: wp.array(dtype=real),
):
    """Return the terms of a block of readings in the sum. Each stage is a loop, which becomes vector code; a hit's mass
    is computed where it may be less than 1 for some reading of the block.
    """
    hits, results = block_numbers(), block_numbers()
    doubtful = int(0)
    i = int(0)
    if WITH_HITS:
        while i < BLOCK_TERMS:
            if CUBES:
                off = z[i] - expected[i]
                hits[i] = term_of.hit_peak(terms) * exp_lanes(-(off * (off * term_of.square_scale(terms))))
            else:
                hits[i] = hit_density_lanes(z[i], expected[i], terms)
            if not AMCL:
                mean = mean_range(expected[i], terms)
                scale = term_of.erf_scale(terms) * hit_scale(expected[i], terms).x
                doubtful += near_an_end(mean, above_mean(expected[i], terms), scale)
            i += 1
    if doubtful > 0:
        inside = masses_within(expected, terms, masses)
        i = int(0)
        while i < BLOCK_TERMS:
            if SCALED:
                hits[i] = hits[i] / inside[i]
            else:
                hits[i] = hits[i] - log_lanes(inside[i])
            i += 1
    i = int(0)
    while i < BLOCK_TERMS:
        if CUBES:
            p = compat_density_lanes(z[i], expected[i], hits[i], terms)
            term = p * p * p
        else:
            hit = hits[i]
            shorter = ZERO
            if not LINEAR:
                shorter = NEVER
                if not HIT:
                    hit = NEVER
            if SHORT:
                shorter = short_density_lanes(z[i], expected[i], terms)
            term = log_of_parts_lanes(hit, shorter, terms)
        if ALL_READINGS:
            term = wp.where(wp.isinf(z[i]), term_of.z_max(terms), term)
            term = wp.where(wp.isnan(z[i]), ZERO, term)
        results[i] = term
        i += 1
    return results


@apart
def block_of_bins(
    z: block_numbers, expected: block_numbers, cosine: block_numbers, terms: wp.array(dtype=MixtureTerms),
    masses: wp.array(dtype=real), edges: wp.array(dtype=real), incidence_bins: wp.int32,
):  # fmt: skip
    """Return the terms of a block of readings whose angles of incidence fall into several bins."""
    values = block_numbers()
    bins = block_bins()
    bin = int(0)
    while bin + 1 < incidence_bins:
        edge = at(edges, bin)
        i = int(0)
        while i < BLOCK_TERMS:
            bins[i] = bins[i] + int(cosine[i] <= edge)
            i += 1
        bin += 1
    bin = int(0)
    while bin < incidence_bins:
        inside = int(0)
        i = int(0)
        while i < BLOCK_TERMS:
            inside += int(bins[i] == bin)
            i += 1
        if inside > 0:
            of_bin = block_terms(z, expected, terms[bin:], masses)
            i = int(0)
            while i < BLOCK_TERMS:
                values[i] = wp.where(bins[i] == bin, of_bin[i], values[i])
                i += 1
        bin += 1
    return values
