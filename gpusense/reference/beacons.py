"""Density of ranges to known beacons, each truncated to [0, range_max] and mixed with a uniform one.

    p(z | d) = z_hit f(z - d - bias) / m  +  z_rand / range_max

d is the distance to the beacon. f is normal, a Student t with nu degrees of freedom, or a sum of two normals, one of
them wide. m is the mass of f on [0, range_max], with d + bias clamped to that interval. For an integer nu the mass of a
t between 0 and t is a finite sum of positive terms (Abramowitz and Stegun, 26.7.3 and 26.7.4).
"""

from __future__ import annotations

import numpy as np
from scipy.special import erf

from gpusense.interface import structs
from gpusense.interface.constants import BEACON, STUDENT_T, TWO_NORMALS
from gpusense.reference.error_free import Pair, add_term, pair_product, pair_sum, two_sum
from gpusense.reference.log_terms import bounded_square, distance_pair, either, offset

# A beacon has its place (x, its low part, y, its low part), the reading minus the bias with its low part, and the bias.
# From this tangent on an arc is a quarter turn to the last bit; the tangent's square is still finite.
STEEPEST = 1e18


def log_normal(residual: Pair, near: np.ndarray, far: np.ndarray, scale: Pair, peak: Pair) -> np.ndarray:
    """Return the log of a truncated normal; near and far are the distances from its mean to the ends."""
    exponent = bounded_square(pair_product(residual, scale))
    mass = near.dtype.type(0.5) * (erf(near * scale[0]) + erf(far * scale[0]))
    return ((peak[0] - exponent[0]) + (peak[1] - exponent[1])) - np.log(mass)


def t_mass(t: np.ndarray, terms: structs.BeaconTerms, series: np.ndarray) -> np.ndarray:
    """Return the mass of a Student t between -t and t; t >= 0 is in units of its scale and sqrt(nu)."""
    real = t.dtype.type
    t = np.minimum(t, real(STEEPEST))
    cosine = 1 / np.sqrt(1 + t * t)
    square, total = cosine * cosine, np.zeros_like(t)
    for term in series[::-1]:
        total = total * square + term
    factor = t * cosine * (cosine if terms.odd > 0 else real(1))
    return terms.arc * np.arctan(t) + factor * total


def log_student_t(
    residual: Pair, near: np.ndarray, far: np.ndarray, terms: structs.BeaconTerms, series: np.ndarray
) -> np.ndarray:
    """Return the log of a truncated Student t: -(nu + 1) / 2 log((1 + u^2 / nu) / k), where k includes the peak."""
    squared = bounded_square(pair_product(residual, (terms.scale, terms.scale_low)))
    x = pair_sum((terms.offset, terms.offset_low), squared)
    half = near.dtype.type(0.5)
    mass = half * (t_mass(near * terms.t_scale, terms, series) + t_mass(far * terms.t_scale, terms, series))
    return (terms.peak - terms.power * (np.log(x[0]) + x[1] / x[0])) - np.log(mass)


def log_range(flags, d, beacon, terms, series, kind):
    """Return log p of one range at each distance."""
    r = two_sum(d[0], -beacon[4])
    r = two_sum(r[0], r[1] + (d[1] - beacon[5]))
    near = np.clip(d[0] + beacon[6], 0, terms.range_max)
    far = terms.range_max - near
    if kind == STUDENT_T:
        log_p = log_student_t(r, near, far, terms, series)
    else:
        log_p = log_normal(r, near, far, (terms.scale, terms.scale_low), (terms.peak, terms.peak_low))
    if kind == TWO_NORMALS:
        wide_scale = (terms.wide_scale, terms.wide_scale_low)
        wide_peak = (terms.wide_peak, terms.wide_peak_low)
        log_p = either(log_p, log_normal(r, near, far, wide_scale, wide_peak))
    return either(log_p, terms.random) if "RAND" in flags else log_p


def score_beacons(flags, place, beacon, terms, series, log_p, particles, beacons, count, kind, temperature):
    """Sum log p of ranges over beacons; the first ``count`` numbers of the series belong to a t."""
    sensor = place[:particles, 0], place[:particles, 1], place[:particles, 2], place[:particles, 3]
    zero = np.zeros(particles, place.dtype)
    total: Pair = (zero, zero)
    for one in beacon.reshape(-1)[: BEACON * beacons].reshape(-1, BEACON):
        d = distance_pair(offset(one[None, [0, 2, 1, 3]], sensor))
        total = add_term(total, log_range(flags, d, one, terms, series[:count], kind))
    log_p[:particles] = np.where(np.isinf(total[0]), total[0], temperature * (total[0] + total[1]))
