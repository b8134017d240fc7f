"""Sums over pairs of reading and expected range from which the beam model's parameters are learned (book table 6.2).

``terms`` are in the log domain, with inverse_sigma and unit_peak. A pair whose reading is NaN is padding. The mean of
p_hit is z* + range_bias, clamped to [0, range_max]; obstacles of p_short lie before z*. r are the responsibilities
e_hit, e_short and e_rand of the book. With u = (z - mean) / sigma, the distances x_0 = mean / sigma and x_1 =
(range_max - mean) / sigma to the ends, phi the untruncated density, W = E' the weight of the shape of a hit (1 for a
normal), B = -E'' / W^2 (0 for a normal), M the mass between the ends and

    T = (x_0 phi_0 + x_1 phi_1) / M,    P = (phi_1 - phi_0) / M,    V = (W_0 x_0 phi_0 + W_1 x_1 phi_1) / M,
    Q = (W_1 x_1^2 phi_1 - W_0 x_0^2 phi_0) / M + P T,    U = (W_0 x_0^3 phi_0 + W_1 x_1^3 phi_1) / M,

log p_hit has the derivatives, by log sigma (s) and by the mean in units of sigma (m),

    h_s = W u^2 - 1 + T,  h_m = W u + P,
    h_ss = W u^2 (B W u^2 - 2) - T + U + T^2,  h_sm = W u (B W u^2 - 2) - P + Q,  h_mm = W (B W u^2 - 1) + V + P^2

and log p_short, by log lambda with x = lambda z*, f = x / (1 - exp(-x)) and v = f - x,

    s_l = 1 - v - lambda z,  s_ll = v (f - 1) - lambda z.
"""

from __future__ import annotations

import numpy as np

from gpusense.interface import structs
from gpusense.interface.constants import BLOCK_TERMS
from gpusense.reference.error_free import add_term
from gpusense.reference.hit_shape import shape_bend, shape_exponent, shape_weight
from gpusense.reference.mixture import (
    above_mean,
    hit_offset,
    log_hit,
    log_short,
    mass_within,
    mean_range,
    short_factor,
)


def responsibilities(flags, z, expected, terms):
    """Return log p(z | z*) and the responsibilities of hit, short and rand, 0 where the density is 0."""
    hit, shorter = log_hit(flags, z, expected, terms), log_short(z, expected, terms)
    largest = np.maximum(np.maximum(hit, shorter), terms.rand_density)
    shift = np.where(np.isinf(largest), 0, largest)
    p_hit, p_short, p_rand = np.exp(hit - shift), np.exp(shorter - shift), np.exp(terms.rand_density - shift)
    p = np.where(np.isinf(largest), 1, p_hit + p_short + p_rand)
    return largest + np.log(p), p_hit / p, p_short / p, p_rand / p


def hit_phi(flags, x, terms):
    """Return the untruncated density of a hit at a distance of x scales, times sigma."""
    t = x.dtype.type(0.5) * x * x
    exponent = shape_exponent(flags, (t, np.zeros_like(t)), terms.shape_power, terms.shape_rate)[0]
    density: np.ndarray = terms.unit_peak * np.exp(-exponent)
    return density


def hit_slopes(flags, z, expected, terms):
    """Return W u^2, and the derivatives h_s, h_m, h_ss, h_sm and h_mm of log p_hit of pairs."""
    mean, above = mean_range(flags, expected, terms), above_mean(flags, expected, terms)
    power, rate, half, scale = terms.shape_power, terms.shape_rate, z.dtype.type(0.5), terms.inverse_sigma
    u, x_0, x_1 = hit_offset(flags, z, expected, terms)[0] * scale, mean * scale, above * scale
    weight = shape_weight(flags, half * u * u, power, rate)
    pull = weight * u
    square = pull * u
    mass = mass_within(flags, mean, above, terms.erf_scale, terms)
    near = mass < 1
    phi_0, phi_1 = (np.where(near, hit_phi(flags, x, terms) / mass, 0) for x in (x_0, x_1))
    pull_0, pull_1 = (
        shape_weight(flags, half * x * x, power, rate) * x * phi for x, phi in ((x_0, phi_0), (x_1, phi_1))
    )
    t, p = x_0 * phi_0 + x_1 * phi_1, phi_1 - phi_0
    q = x_1 * pull_1 - x_0 * pull_0 + p * t
    w = x_0 * x_0 * pull_0 + x_1 * x_1 * pull_1
    bend = shape_bend(flags, square, power)
    # A clamped mean does not move with the bias.
    moves = mean == expected + terms.range_bias
    h_m = np.where(moves, pull + p, 0)
    h_sm = np.where(moves, pull * (bend - 2) - p + q, 0)
    h_mm = np.where(moves, weight * (bend - 1) + pull_0 + pull_1 + p * p, 0)
    return square, square - 1 + t, h_m, square * (bend - 2) - t + w + t * t, h_sm, h_mm


def short_slopes(z: np.ndarray, expected: np.ndarray, terms: structs.MixtureTerms) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivatives s_l and s_ll of log p_short of pairs."""
    x = terms.lambda_short * expected
    f = short_factor(x)
    v = f - x
    return 1 - v - terms.lambda_short * z, v * (f - 1) - terms.lambda_short * z


def add_pair(flags, z, expected, terms, sums):
    """Return the terms of pairs in the sums, (S, pairs).

    log p; r; r_hit h_s, r_hit h_m, r_short s_l; r_hit h_ss, r_hit h_sm, r_hit h_mm, r_short s_ll; r_hit W u^2, r_short
    z. INFORMATION: 1 where rand is the likeliest cause; the upper triangle of y y' with y = (r_hit, r_short, r_rand,
    r_hit h_s, r_hit h_m, r_short s_l); r_hit h_s^2, r_hit h_s h_m, r_hit h_m^2, r_short s_l^2.
    """
    log_p, r_hit, r_short, r_rand = responsibilities(flags, z, expected, terms)
    slopes = hit_slopes(flags, z, expected, terms)
    square, h_s, h_m, h_ss, h_sm, h_mm = (np.where(r_hit > 0, slope, 0) for slope in slopes)
    s_l, s_ll = (np.where(r_short > 0, slope, 0) for slope in short_slopes(z, expected, terms))
    added = [log_p, r_hit, r_short, r_rand]
    added += [r_hit * h_s, r_hit * h_m, r_short * s_l, r_hit * h_ss, r_hit * h_sm, r_hit * h_mm, r_short * s_ll]
    added += [r_hit * square, r_short * z]
    if "INFORMATION" in flags:
        added.append(((r_rand > r_hit) & (r_rand > r_short)).astype(z.dtype))
        y = (r_hit, r_short, r_rand, r_hit * h_s, r_hit * h_m, r_short * s_l)
        added += [y[i] * y[j] for i in range(6) for j in range(i, 6)]
        added += [r_hit * h_s * h_s, r_hit * h_s * h_m, r_hit * h_m * h_m, r_short * s_l * s_l]
    for j, term in enumerate(added):
        sums[j] += np.where(np.isnan(z), 0, term)


def e_step(flags, reading, expected, terms, masses, sums, blocks, readings, across, along, width):
    """Sum over blocks of pairs; pair k of a block is pair block * across + k * along."""
    count = 39 if "INFORMATION" in flags else 13
    total = (np.zeros((count, blocks), reading.dtype), np.zeros((count, blocks), reading.dtype))
    starts = np.arange(blocks) * across
    for first in range(0, readings, BLOCK_TERMS):
        part = np.zeros((count, blocks), reading.dtype)
        for k in range(first, min(first + BLOCK_TERMS, readings)):
            pairs = starts + k * along
            add_pair(flags, reading[pairs], expected[pairs], terms, part)
        total = add_term(total, part)
    sums[: blocks * width].reshape(blocks, width)[:, :count] = (total[0] + total[1]).T


def pair_causes(flags, reading, expected, terms, masses, causes, blocks, readings, across, along):
    """Write log p and the responsibilities of each pair, NaN for padding."""
    starts = np.arange(blocks) * across
    for k in range(readings):
        pairs = starts + k * along
        stacked = np.stack(responsibilities(flags, reading[pairs], expected[pairs], terms), axis=-1)
        causes[pairs] = np.where(np.isnan(reading[pairs])[:, None], np.nan, stacked)
