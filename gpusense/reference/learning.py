"""Sums over pairs of reading and expected range from which the beam model's parameters are learned (book table 6.2).

``terms`` (12,) are the mixture's ten in the log domain, range_bias and 1 / sigma. A pair whose reading is NaN is
padding. The mean of p_hit is z* + range_bias, clamped to [0, range_max]; obstacles of p_short lie before z*. r are the
responsibilities e_hit, e_short and e_rand of the book. With u = (z - mean) / sigma, the distances x_0 = mean / sigma
and x_1 = (range_max - mean) / sigma to the ends, phi the normal density, M the mass between them and

    T = (x_0 phi_0 + x_1 phi_1) / M,    P = (phi_1 - phi_0) / M,
    Q = (x_1^2 phi_1 - x_0^2 phi_0) / M + P T,    U = (x_0^3 phi_0 + x_1^3 phi_1) / M,

log p_hit has the derivatives, by log sigma (s) and by the mean in units of sigma (m),

    h_s = u^2 - 1 + T,  h_m = u + P,  h_ss = -2 u^2 - T + U + T^2,  h_sm = -2 u - P + Q,  h_mm = -1 + T + P^2

and log p_short, by log lambda with x = lambda z*, f = x / (1 - exp(-x)) and v = f - x,

    s_l = 1 - v - lambda z,  s_ll = v (f - 1) - lambda z.
"""

from __future__ import annotations

import math

import numpy as np

from gpusense.interface.constants import BLOCK_TERMS
from gpusense.reference.error_free import add_term
from gpusense.reference.mixture import hit_mass, log_hit, log_short, short_factor

ROOT_2PI = math.sqrt(2 * math.pi)


def hit_mean(expected: np.ndarray, terms: np.ndarray) -> np.ndarray:
    """Return the mean of p_hit."""
    return np.minimum(np.maximum(expected + terms[10], 0), terms[6])


def responsibilities(
    flags: frozenset[str], z: np.ndarray, expected: np.ndarray, terms: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return log p(z | z*) and the responsibilities of hit, short and rand, 0 where the density is 0."""
    hit, shorter = log_hit(flags, z, hit_mean(expected, terms), terms), log_short(z, expected, terms)
    largest = np.maximum(np.maximum(hit, shorter), terms[5])
    shift = np.where(np.isinf(largest), 0, largest)
    p_hit, p_short, p_rand = np.exp(hit - shift), np.exp(shorter - shift), np.exp(terms[5] - shift)
    p = np.where(np.isinf(largest), 1, p_hit + p_short + p_rand)
    return largest + np.log(p), p_hit / p, p_short / p, p_rand / p


def add_pair(flags: frozenset[str], z: np.ndarray, expected: np.ndarray, terms: np.ndarray, sums: np.ndarray) -> None:
    """Return the terms of pairs in the sums, (S, pairs).

    log p; r; r_hit h_s, r_hit h_m, r_short s_l; r_hit h_ss, r_hit h_sm, r_hit h_mm, r_short s_ll; r_hit (z - z*)^2,
    r_hit (z - z*), r_short z. INFORMATION: 1 where rand is the likeliest cause; the upper triangle of y y' with y =
    (r_hit, r_short, r_rand, r_hit h_s, r_hit h_m, r_short s_l); r_hit h_s^2, r_hit h_s h_m, r_hit h_m^2, r_short s_l^2.
    """
    real = terms.dtype.type
    log_p, r_hit, r_short, r_rand = responsibilities(flags, z, expected, terms)

    mean = hit_mean(expected, terms)
    u, x_0, x_1 = (z - mean) * terms[11], mean * terms[11], (terms[6] - mean) * terms[11]
    mass = hit_mass(mean, terms[2], terms[6])
    near = mass < 1
    phi_0 = np.where(near, np.exp(real(-0.5) * x_0 * x_0) / (real(ROOT_2PI) * mass), 0)
    phi_1 = np.where(near, np.exp(real(-0.5) * x_1 * x_1) / (real(ROOT_2PI) * mass), 0)
    t, p = x_0 * phi_0 + x_1 * phi_1, phi_1 - phi_0
    q = x_1 * x_1 * phi_1 - x_0 * x_0 * phi_0 + p * t
    w = x_0 * x_0 * x_0 * phi_0 + x_1 * x_1 * x_1 * phi_1
    hit = r_hit > 0
    # A mean that is clamped does not move with the bias.
    moved = hit & (mean == expected + terms[10])
    h_s = np.where(hit, u * u - 1 + t, 0)
    h_m = np.where(moved, u + p, 0)
    h_ss = np.where(hit, -2 * u * u - t + w + t * t, 0)
    h_sm = np.where(moved, -2 * u - p + q, 0)
    h_mm = np.where(moved, -1 + t + p * p, 0)

    x = terms[4] * expected
    f = short_factor(x)
    v = f - x
    s_l = np.where(r_short > 0, 1 - v - terms[4] * z, 0)
    s_ll = np.where(r_short > 0, v * (f - 1) - terms[4] * z, 0)

    off = z - expected
    added = [log_p, r_hit, r_short, r_rand]
    added += [r_hit * h_s, r_hit * h_m, r_short * s_l, r_hit * h_ss, r_hit * h_sm, r_hit * h_mm, r_short * s_ll]
    added += [r_hit * off * off, r_hit * off, r_short * z]
    if "INFORMATION" in flags:
        added.append(((r_rand > r_hit) & (r_rand > r_short)).astype(real))
        y = (r_hit, r_short, r_rand, r_hit * h_s, r_hit * h_m, r_short * s_l)
        added += [y[i] * y[j] for i in range(6) for j in range(i, 6)]
        added += [r_hit * h_s * h_s, r_hit * h_s * h_m, r_hit * h_m * h_m, r_short * s_l * s_l]
    for j, term in enumerate(added):
        sums[j] += np.where(np.isnan(z), 0, term)


def e_step(
    flags: frozenset[str],
    reading: np.ndarray,
    expected: np.ndarray,
    terms: np.ndarray,
    sums: np.ndarray,
    blocks: int,
    readings: int,
    across: int,
    along: int,
    width: int,
) -> None:
    """Sum over blocks of pairs; pair k of a block is pair block * across + k * along."""
    count = 40 if "INFORMATION" in flags else 14
    total = (np.zeros((count, blocks), terms.dtype), np.zeros((count, blocks), terms.dtype))
    starts = np.arange(blocks) * across
    for first in range(0, readings, BLOCK_TERMS):
        part = np.zeros((count, blocks), terms.dtype)
        for k in range(first, min(first + BLOCK_TERMS, readings)):
            pairs = starts + k * along
            add_pair(flags, reading[pairs], expected[pairs], terms, part)
        total = add_term(total, part)
    sums[: blocks * width].reshape(blocks, width)[:, :count] = (total[0] + total[1]).T


def pair_causes(
    flags: frozenset[str],
    reading: np.ndarray,
    expected: np.ndarray,
    terms: np.ndarray,
    causes: np.ndarray,
    blocks: int,
    readings: int,
    across: int,
    along: int,
) -> None:
    """Write log p and the responsibilities of each pair, NaN for padding."""
    starts = np.arange(blocks) * across
    for k in range(readings):
        pairs = starts + k * along
        stacked = np.stack(responsibilities(flags, reading[pairs], expected[pairs], terms), axis=-1)
        causes[pairs] = np.where(np.isnan(reading[pairs])[:, None], np.nan, stacked)
