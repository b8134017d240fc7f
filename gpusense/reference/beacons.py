"""Density of ranges to known beacons, each truncated to [0, range_max] and mixed with a uniform one.

    p(z | d) = z_hit f(z - d - bias) / m  +  z_rand / range_max

d is the distance to the beacon. f is normal, a Student t with nu degrees of freedom, or a sum of two normals, one of
them wide. m is the mass of f on [0, range_max], with d + bias clamped to that interval. For an integer nu the mass of a
t between 0 and t is a finite sum of positive terms (Abramowitz and Stegun, 26.7.3 and 26.7.4).
"""

from __future__ import annotations

import numpy as np
from scipy.special import erf

from gpusense.interface.constants import BEACON, STUDENT_T, TWO_NORMALS
from gpusense.reference.error_free import Pair, add_term, pair_product, pair_sum, two_sum
from gpusense.reference.log_terms import bounded_square, either
from gpusense.reference.offsets import distance_pair, offset

# A beacon has its place (x, its low part, y, its low part), the reading minus the bias with its low part, and the bias.
# 1 / (sigma sqrt 2), log of z_hit and the peak, log of the uniform part, range_max; for two normals, scale and peak of
# the wide one. For a t with peak P: 1 / (sigma sqrt(nu k)) with k = P^(2 / (nu + 1)), log z_hit, and in place
# of the wide normal: 1 / k, (nu + 1) / 2, 1 / (sigma sqrt nu), the factor of the arc, and 1 for an odd nu.
SCALE, SCALE_LOW, PEAK, PEAK_LOW, RANDOM, RANGE_MAX = range(6)
WIDE_SCALE, WIDE_SCALE_LOW, WIDE_PEAK, WIDE_PEAK_LOW = range(6, 10)
OFFSET, OFFSET_LOW, POWER, T_SCALE, ARC, ODD = range(6, 12)
# From this tangent on an arc is a quarter turn to the last bit; the tangent's square is still finite.
STEEPEST = 1e18


def log_normal(
    residual: Pair, near: np.ndarray, far: np.ndarray, terms: np.ndarray, first: int, peak: int
) -> np.ndarray:
    """Return the log of a truncated normal; near and far are the distances from its mean to the ends."""
    scale = np.asarray(terms[first]), np.asarray(terms[first + 1])
    exponent = bounded_square(pair_product(residual, scale))
    mass = terms.dtype.type(0.5) * (erf(near * terms[first]) + erf(far * terms[first]))
    return ((terms[peak] - exponent[0]) + (terms[peak + 1] - exponent[1])) - np.log(mass)


def t_mass(t: np.ndarray, terms: np.ndarray, series: np.ndarray) -> np.ndarray:
    """Return the mass of a Student t between -t and t; t >= 0 is in units of its scale and sqrt(nu)."""
    real = terms.dtype.type
    t = np.minimum(t, real(STEEPEST))
    cosine = 1 / np.sqrt(1 + t * t)
    square, total = cosine * cosine, np.zeros_like(t)
    for term in series[::-1]:
        total = total * square + term
    factor = t * cosine * (cosine if terms[ODD] > 0 else real(1))
    return terms[ARC] * np.arctan(t) + factor * total


def log_student_t(
    residual: Pair, near: np.ndarray, far: np.ndarray, terms: np.ndarray, series: np.ndarray
) -> np.ndarray:
    """Return the log of a truncated Student t: -(nu + 1) / 2 log((1 + u^2 / nu) / k), where k includes the peak."""
    squared = bounded_square(pair_product(residual, (np.asarray(terms[SCALE]), np.asarray(terms[SCALE_LOW]))))
    x = pair_sum((np.asarray(terms[OFFSET]), np.asarray(terms[OFFSET_LOW])), squared)
    half = terms.dtype.type(0.5)
    mass = half * (t_mass(near * terms[T_SCALE], terms, series) + t_mass(far * terms[T_SCALE], terms, series))
    return (terms[PEAK] - terms[POWER] * (np.log(x[0]) + x[1] / x[0])) - np.log(mass)


def log_range(
    flags: frozenset[str], d: Pair, beacon: np.ndarray, terms: np.ndarray, series: np.ndarray, kind: int
) -> np.ndarray:
    """Return log p of one range at each distance."""
    r = two_sum(d[0], -beacon[4])
    r = two_sum(r[0], r[1] + (d[1] - beacon[5]))
    near = np.clip(d[0] + beacon[6], 0, terms[RANGE_MAX])
    far = terms[RANGE_MAX] - near
    if kind == STUDENT_T:
        log_p = log_student_t(r, near, far, terms, series)
    else:
        log_p = log_normal(r, near, far, terms, SCALE, PEAK)
    if kind == TWO_NORMALS:
        log_p = either(log_p, log_normal(r, near, far, terms, WIDE_SCALE, WIDE_PEAK))
    return either(log_p, terms[RANDOM]) if "RAND" in flags else log_p


def score_beacons(
    flags: frozenset[str], place: np.ndarray, beacon: np.ndarray, terms: np.ndarray, series: np.ndarray,
    log_p: np.ndarray, particles: int, beacons: int, count: int, kind: int, temperature: float,
) -> None:  # fmt: skip
    """Sum log p of ranges over beacons; the first ``count`` numbers of the series belong to a t."""
    sensor = place[:particles, 0], place[:particles, 1], place[:particles, 2], place[:particles, 3]
    zero = np.zeros(particles, place.dtype)
    total: Pair = (zero, zero)
    for one in beacon.reshape(-1)[: BEACON * beacons].reshape(-1, BEACON):
        d = distance_pair(offset(one[None, [0, 2, 1, 3]], sensor))
        total = add_term(total, log_range(flags, d, one, terms, series[:count], kind))
    log_p[:particles] = np.where(np.isinf(total[0]), total[0], temperature * (total[0] + total[1]))
