"""Sums over pairs of reading and expected range from which the beam model's parameters are learned (book table 6.2)."""

import math

import warp as wp

from gpusense.interface.constants import BLOCK_TERMS

from .flags import INFORMATION
from .hit_shape import shape_bend, shape_exponent, shape_weight
from .mixture import above_mean, hit_offset, log_hit, log_short, mass_within, mean_range, short_factor
from .prelude import kernel
from .types import MixtureTerms, real, vec2, vec4

SUMS = 39 if INFORMATION else 13
sums_type = wp.types.vector(length=SUMS, dtype=real)
vec6 = wp.types.vector(length=6, dtype=real)
ZERO, ONE = real(0.0), real(1.0)
HALF, TWO = real(0.5), real(2.0)
NOTHING = real(math.nan)


@wp.func
def responsibilities(z: real, expected: real, terms: wp.array(dtype=MixtureTerms), masses: wp.array(dtype=real)):
    """Return log p(z | z*) and the responsibilities of hit, short and rand, 0 where the density is 0."""
    hit = log_hit(z, expected, terms, masses)
    shorter = log_short(z, expected, terms)
    largest = wp.max(wp.max(hit, shorter), terms[0].rand_density)
    if wp.isinf(largest):
        return vec4(largest, ZERO, ZERO, ZERO)
    p_hit = wp.exp(hit - largest)
    p_short = wp.exp(shorter - largest)
    p_rand = wp.exp(terms[0].rand_density - largest)
    p = p_hit + p_short + p_rand
    return vec4(largest + wp.log(p), p_hit / p, p_short / p, p_rand / p)


@wp.func
def hit_phi(x: real, terms: wp.array(dtype=MixtureTerms)):
    """Return the untruncated density of a hit at a distance of x scales, times sigma."""
    t = vec2(HALF * x * x, ZERO)
    return terms[0].unit_peak * wp.exp(-shape_exponent(t, terms[0].shape_power, terms[0].shape_rate).x)


@wp.func
def hit_slopes(z: real, expected: real, terms: wp.array(dtype=MixtureTerms), masses: wp.array(dtype=real)):
    """Return W u^2, and the derivatives h_s, h_m, h_ss, h_sm and h_mm of log p_hit of a pair."""
    mean = mean_range(expected, terms)
    above = above_mean(expected, terms)
    u = hit_offset(z, expected, terms).x * terms[0].inverse_sigma
    x_0 = mean * terms[0].inverse_sigma
    x_1 = above * terms[0].inverse_sigma
    weight = shape_weight(HALF * u * u, terms[0].shape_power, terms[0].shape_rate)
    pull = weight * u
    square = pull * u
    t = real(0.0)
    p = real(0.0)
    v = real(0.0)
    q = real(0.0)
    w = real(0.0)
    mass = mass_within(mean, above, terms[0].erf_scale, terms, masses)
    if mass < ONE:
        phi_0 = hit_phi(x_0, terms) / mass
        phi_1 = hit_phi(x_1, terms) / mass
        pull_0 = shape_weight(HALF * x_0 * x_0, terms[0].shape_power, terms[0].shape_rate) * x_0 * phi_0
        pull_1 = shape_weight(HALF * x_1 * x_1, terms[0].shape_power, terms[0].shape_rate) * x_1 * phi_1
        t = x_0 * phi_0 + x_1 * phi_1
        p = phi_1 - phi_0
        v = pull_0 + pull_1
        q = x_1 * pull_1 - x_0 * pull_0 + p * t
        w = x_0 * x_0 * pull_0 + x_1 * x_1 * pull_1
    bend = shape_bend(square, terms[0].shape_power)
    h_m = pull + p
    h_sm = pull * (bend - TWO) - p + q
    h_mm = weight * (bend - ONE) + v + p * p
    # A clamped mean does not move with the bias.
    if mean != expected + terms[0].range_bias:
        h_m = ZERO
        h_sm = ZERO
        h_mm = ZERO
    return vec6(square, square - ONE + t, h_m, square * (bend - TWO) - t + w + t * t, h_sm, h_mm)


@wp.func
def short_slopes(z: real, expected: real, terms: wp.array(dtype=MixtureTerms)):
    """Return the derivatives s_l and s_ll of log p_short of a pair."""
    x = terms[0].lambda_short * expected
    f = short_factor(x)
    v = f - x
    return vec2(ONE - v - terms[0].lambda_short * z, v * (f - ONE) - terms[0].lambda_short * z)


@wp.func
def add_pair(
    z: real, expected: real, terms: wp.array(dtype=MixtureTerms), masses: wp.array(dtype=real), before: sums_type,
):  # fmt: skip
    """Add the terms of a pair to the sums."""
    sums = before
    r = responsibilities(z, expected, terms, masses)
    hit = vec6()
    shorter = vec2()
    if r[1] > ZERO:
        hit = hit_slopes(z, expected, terms, masses)
    if r[2] > ZERO:
        shorter = short_slopes(z, expected, terms)
    h_s = hit[1]
    h_m = hit[2]
    s_l = shorter.x
    sums[0] += r[0]
    sums[1] += r[1]
    sums[2] += r[2]
    sums[3] += r[3]
    sums[4] += r[1] * h_s
    sums[5] += r[1] * h_m
    sums[6] += r[2] * s_l
    sums[7] += r[1] * hit[3]
    sums[8] += r[1] * hit[4]
    sums[9] += r[1] * hit[5]
    sums[10] += r[2] * shorter.y
    sums[11] += r[1] * hit[0]
    sums[12] += r[2] * z
    if INFORMATION:
        if r[3] > r[1] and r[3] > r[2]:
            sums[13] += ONE
        y = vec6(r[1], r[2], r[3], r[1] * h_s, r[1] * h_m, r[2] * s_l)
        place = int(14)
        i = int(0)
        while i < 6:
            j = i
            while j < 6:
                sums[place] += y[i] * y[j]
                place += 1
                j += 1
            i += 1
        sums[35] += r[1] * h_s * h_s
        sums[36] += r[1] * h_s * h_m
        sums[37] += r[1] * h_m * h_m
        sums[38] += r[2] * s_l * s_l
    return sums


@kernel
def e_step(reading, expected, terms, masses, sums, blocks, readings, across, along, width):
    """Sum over blocks of pairs: one work-item takes a block."""
    block = wp.tid()
    if block >= blocks:
        return
    total = sums_type()
    total_low = sums_type()
    first = int(0)
    while first < readings:
        last = wp.min(first + BLOCK_TERMS, readings)
        part = sums_type()
        k = first
        while k < last:
            n = block * across + k * along
            if not wp.isnan(reading[n]):
                part = add_pair(reading[n], expected[n], terms, masses, part)
            k += 1
        # add_term, for all sums at once.
        head = total + part
        shift = head - total
        total_low += (total - (head - shift)) + (part - shift)
        total = head
        first += BLOCK_TERMS
    j = int(0)
    while j < SUMS:
        sums[block * width + j] = total[j] + total_low[j]
        j += 1


@kernel
def pair_causes(reading, expected, terms, masses, causes, blocks, readings, across, along):
    """Write log p and the responsibilities of each pair, NaN for padding. One work-item takes a block of pairs."""
    block = wp.tid()
    if block >= blocks:
        return
    k = int(0)
    while k < readings:
        n = block * across + k * along
        if wp.isnan(reading[n]):
            causes[n] = vec4(NOTHING, NOTHING, NOTHING, NOTHING)
        else:
            causes[n] = responsibilities(reading[n], expected[n], terms, masses)
        k += 1
