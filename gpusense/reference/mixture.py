"""Beam mixture density of one range reading, log p(z | z*), book equations 6.4 to 6.12 without the max atom.

Causes are numbered as in the book: 1 correct range (hit), 2 unexpected object (short), 3 failure (max), 4 random
measurement (rand). The density has 1, 2 and 4; the caller adds 3. In the linear domain hit_peak, z_short and
rand_density are densities, in the log domain their logarithms. The mean of p_hit is z* + range_bias on [0, range_max]
(BIAS), and its sigma is sigma_hit + sigma_growth z* (GROWTH). Masses of hits are computed; only kernels look them up.
"""

from __future__ import annotations

import numpy as np
from scipy.special import erf

from gpusense.interface import structs
from gpusense.reference.error_free import pair_sum, rest_of, two_product, two_sum
from gpusense.reference.hit_shape import half_mass, shape_exponent

TINY = 1e-30
SMALLEST_RANGE = 1e-37


def last_range(z: np.ndarray, terms: structs.MixtureTerms) -> np.ndarray:
    """Return the expected ranges of readings beyond which log p is constant to the last bit.

    There log p is that of p_rand, or of p_short far from its end, whatever the distance of the obstacle.
    """
    return np.maximum(terms.last_offset + terms.last_slope * z, terms.last_least)


def hit_mass(before: np.ndarray, after: np.ndarray, erf_scale: float | np.ndarray) -> np.ndarray:
    """Return the mass of the normal from a distance before its mean to one after it, a sum of positive terms."""
    half = before.dtype.type(0.5)
    return half * (erf(before * erf_scale) + erf(after * erf_scale))


def mass_within(flags, mean, above, scale, terms):
    """Return the mass of a hit of any shape on [0, range_max], given its mean and the distance to range_max."""
    if "MASS_TABLE" not in flags:
        return hit_mass(mean, above, scale)
    below, above_mass = (
        half_mass(flags, distance * scale, terms.shape_power, terms.shape_rate) for distance in (mean, above)
    )
    return below + above_mass


def mean_range(flags, expected, terms):
    """Return the mean of p_hit."""
    return np.clip(expected + terms.range_bias, 0, terms.range_max) if "BIAS" in flags else expected


def above_mean(flags, expected, terms):
    """Return the distance from the mean of p_hit to range_max, which keeps its digits where it is short."""
    if "BIAS" not in flags:
        return terms.range_max - expected
    last, rest = two_sum(terms.range_max, -terms.range_bias)
    return np.clip((last - expected) + (rest - terms.range_bias_low), 0, terms.range_max)


def hit_offset(flags, z, expected, terms):
    """Return z minus the mean of p_hit as a sum of two numbers; z, z* and the bias nearly cancel."""
    off = z - expected
    none = np.zeros_like(off)
    if "BIAS" not in flags:
        return off, none
    mean = mean_range(flags, expected, terms)
    high, low = pair_sum(two_sum(z, -expected), (none - terms.range_bias, none - terms.range_bias_low))
    moved = mean == expected + terms.range_bias
    return np.where(moved, high, z - mean), np.where(moved, low, none)


def hit_scale(flags, expected, terms):
    """Return sigma_hit / sigma at ranges: the first number times (1 + the second)."""
    one, none = np.ones_like(expected), np.zeros_like(expected)
    if "GROWTH" not in flags:
        return one, none
    if "EXACT_EXPONENT" not in flags:
        return one / (one + terms.relative_growth * expected), none
    total = one + terms.relative_growth * expected
    share = one / total
    # Rounding error of the sum; below 2^24 the sum less 1 is exact.
    excess = rest_of(terms.relative_growth + none, expected, total - one) - terms.relative_growth_low * expected
    return share, rest_of(total, share, one) + excess * share


def normal_exponent(flags, z, expected, terms):
    """Return ``(z - mean)^2 / (2 sigma^2)`` as a sum of two numbers.

    Exponent and log peak are large and nearly cancel where the density's peak is high; the second part keeps the digits
    that remain.
    """
    off, off_low = hit_offset(flags, z, expected, terms)
    scale = hit_scale(flags, expected, terms)
    scaled = off * scale[0]
    if "EXACT_EXPONENT" not in flags:
        return scaled * (scaled * terms.square_scale), np.zeros_like(off)
    if "GROWTH" in flags:
        off_low = (off_low * scale[0] + scaled * scale[1]) - rest_of(off, scale[0], scaled)
        off = scaled
    square, square_low = two_product(off, off)
    square_low = square_low + 2 * off * off_low
    product = two_product(square, terms.square_scale)
    return product[0], product[1] + (square_low * terms.square_scale + square * terms.square_scale_low)


def hit_exponent(flags, z, expected, terms):
    """Return the exponent of a hit's density as a sum of two numbers."""
    return shape_exponent(flags, normal_exponent(flags, z, expected, terms), terms.shape_power, terms.shape_rate)


def log_hit(flags, z, expected, terms):
    """Return ``log(z_hit p_hit(z | z*))``; terms are in the log domain."""
    exponent = hit_exponent(flags, z, expected, terms)
    scale = hit_scale(flags, expected, terms)[0]
    log_p = (terms.hit_peak - exponent[0]) + (terms.hit_peak_low - exponent[1]) + np.log(scale)
    mean, above = mean_range(flags, expected, terms), above_mean(flags, expected, terms)
    return log_p - np.log(mass_within(flags, mean, above, terms.erf_scale * scale, terms))


def short_factor(x: np.ndarray) -> np.ndarray:
    """Return ``x / (1 - exp(-x))`` for x >= 0 as h / tanh(h) + h with h = x / 2."""
    h = x.dtype.type(0.5) * x
    safe = np.where(h > TINY, h, 1)
    return np.where(h > TINY, safe / np.tanh(safe) + h, x.dtype.type(1))


def short_peak(decay: float, expected: np.ndarray) -> np.ndarray:
    """Return ``lambda / (1 - exp(-2 h))`` as lambda (1 + t) / (2 t), h = lambda z* / 2 and t = tanh(h); 1 / z* at 0."""
    h = expected.dtype.type(0.5) * (decay * expected)
    t = np.tanh(np.where(h > TINY, h, 1))
    return np.where(h > TINY, decay * (1 + t), 1) / np.where(h > TINY, 2 * t, np.maximum(expected, SMALLEST_RANGE))


def log_short(z: np.ndarray, expected: np.ndarray, terms: structs.MixtureTerms) -> np.ndarray:
    """Return ``log(z_short p_short(z | z*))``; terms are in the log domain."""
    inside = (z <= expected) & (expected > 0)
    log_p = (terms.z_short + np.log(short_peak(terms.lambda_short, expected))) - terms.lambda_short * z
    return np.where(inside, log_p, -np.inf)


def log_density(flags, z, expected, terms):
    """Return log p(z | z*) of readings in [0, range_max) given expected ranges of the same shape."""
    if "LINEAR" in flags:
        # p_rand > 0 bounds the sum from below, so components may underflow, and one logarithm suffices.
        p = np.zeros(z.shape, z.dtype)
        if "HIT" in flags:
            # 1: correct range.
            exponent = hit_exponent(flags, z, expected, terms)
            scale = hit_scale(flags, expected, terms)[0]
            mean, above = mean_range(flags, expected, terms), above_mean(flags, expected, terms)
            mass = mass_within(flags, mean, above, terms.erf_scale * scale, terms)
            p += terms.hit_peak * scale * np.exp(-exponent[0]) * (1 - exponent[1]) / mass
        if "SHORT" in flags:
            # 2: unexpected object.
            density = terms.z_short * np.exp(-terms.lambda_short * z) * short_peak(terms.lambda_short, expected)
            p += np.where((z <= expected) & (expected > 0), density, 0)
        # 4: random measurement.
        return np.log(p + terms.rand_density)
    parts = []
    if "HIT" in flags:
        parts.append(log_hit(flags, z, expected, terms))  # 1: correct range
    if "SHORT" in flags:
        parts.append(log_short(z, expected, terms))  # 2: unexpected object
    if "RAND" in flags:
        parts.append(np.broadcast_to(terms.rand_density, z.shape))  # 4: random measurement
    if len(parts) == 1:
        return parts[0].astype(z.dtype)
    return np.logaddexp.reduce(parts, axis=0).astype(z.dtype)


def compat_density(flags, z, expected, terms):
    """Return the density whose cube nav2_amcl and Beluga add for each beam of a scan.

    amcl's is without normalisers, Beluga's with both (book table 6.1). Terms are linear; hit_peak is z_hit alone for
    amcl, and z_max is no logarithm. A reading of range_max is a max reading; amcl's longer readings are neither
    random nor max readings.
    """
    off = z - expected
    p = terms.hit_peak * np.exp(-(off * (off * terms.square_scale)))
    if "AMCL" in flags:
        short = terms.z_short * terms.lambda_short * np.exp(-terms.lambda_short * z)
    else:
        p = p / hit_mass(expected, terms.range_max - expected, terms.erf_scale)
        short = terms.z_short * short_factor(terms.lambda_short * expected) * np.exp(-terms.lambda_short * z) / expected
    p = p + np.where(z < expected, short, 0)
    at_max = np.where(z > terms.range_max, 0, terms.z_max) if "AMCL" in flags else terms.z_max
    return (p + np.where(z >= terms.range_max, at_max, terms.rand_density)).astype(z.dtype)
