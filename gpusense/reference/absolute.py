"""Densities of absolute sensors, which measure a position in the plane or a heading.

A position is normal around the truth. A heading is wrapped normal, sum_k N(r + 2 pi k; 0, sigma): computed by its
largest terms up to sigma = 1.5, and for larger sigma by its Fourier series (1 + 2 sum_n q^(n n) cos n r) / (2 pi) with
q = exp(-sigma^2 / 2). Or a heading is von Mises, exp(kappa cos r) / (2 pi I0(kappa)) with kappa cos r = kappa - 2 kappa
sin^2(r / 2). Mardia and Jupp, *Directional Statistics* (2000), section 3.5. z_rand is the weight of a uniform density
(RAND).
"""

from __future__ import annotations

import numpy as np

from gpusense.interface.constants import NEARBY, SERIES, VON_MISES, WAVES, WRAPS
from gpusense.reference.error_free import Pair, pair_product, pair_sum, two_sum
from gpusense.reference.log_terms import bounded_square, either, log_one_plus

HALF_TURN = 3.141592653589793
# sin x = x + x z (SINE[0] + SINE[1] z + ...) with z = x^2, its power series.
SINE = (
    -0.16666666666666666, 0.008333333333333333, -0.0001984126984126984, 2.7557319223985893e-06,
    -2.505210838544172e-08, 1.6059043836821613e-10, -7.647163731819816e-13, 2.8114572543455206e-15,
    -8.22063524662433e-18, 1.9572941063391263e-20,
)  # fmt: skip


def half_sine(residual: Pair) -> Pair:
    """Return ``sin(r / 2)`` of an angle in [-pi, pi]."""
    real = residual[0].dtype.type
    x, x_low = real(0.5) * residual[0], real(0.5) * residual[1]
    z, series = x * x, real(0)
    for term in SINE[::-1]:
        series = series * z + real(term)
    return two_sum(x, x_low + x * (z * series))


def log_other_turns(residual: Pair, decay: float) -> np.ndarray:
    """Return the log of the ratio of the sum over all turns to the normal of the nearest turn."""
    real = residual[0].dtype.type
    half, size = real(HALF_TURN), np.abs(residual[0])
    low = np.where(residual[0] < 0, -residual[1], residual[1])
    rest = np.maximum((half - size) + (real(HALF_TURN - float(half)) - low), 0)
    others = np.zeros_like(size)
    for k in range(1, WRAPS + 1):
        others = others + np.exp(-decay * real(k) * (real(k - 1) * half + rest))
        others = others + np.exp(-decay * real(k) * (real(k) * half + size))
    return log_one_plus(others)


def log_waves(residual: Pair, waves: np.ndarray) -> np.ndarray:
    """Return the log of the ratio of the Fourier series to its first term, by Clenshaw's recurrence."""
    real = residual[0].dtype.type
    s = half_sine(residual)[0]
    cosine = 1 - 2 * s * s
    newer, older = np.zeros_like(s), np.zeros_like(s)
    for n in range(WAVES, 0, -1):
        newer, older = waves[n - 1] + real(2) * cosine * newer - older, newer
    return log_one_plus(cosine * newer - older)


def score_position(flags, place, terms, log_p, particles, temperature):
    """Score positions.

    The exponent is ``(x_scale x)^2 + (shear x + y_scale y)^2``, where (x, y) is the offset from the reading to the
    sensor.
    """
    x, y = (place[:particles, 0], place[:particles, 1]), (place[:particles, 2], place[:particles, 3])
    x_scale = terms.x_scale, terms.x_scale_low
    y_scale = terms.y_scale, terms.y_scale_low
    shear = terms.shear, terms.shear_low
    first = bounded_square(pair_product(x, x_scale))
    second = bounded_square(pair_sum(pair_product(x, shear), pair_product(y, y_scale)))
    exponent = pair_sum(first, second)
    log_density = (terms.peak - exponent[0]) + (terms.peak_low - exponent[1])
    if "RAND" in flags:
        log_density = either(log_density, terms.random)
    log_p[:particles] = temperature * log_density


def score_heading(flags, residual, terms, waves, log_p, particles, kind, temperature):
    """Score headings; residuals are headings minus the reading, in [-pi, pi]."""
    r = residual[:particles, 0], residual[:particles, 1]
    scale = terms.scale, terms.scale_low
    if kind == SERIES:
        log_density = terms.peak + (terms.peak_low + log_waves(r, waves))
    else:
        root = half_sine(r) if kind == VON_MISES else r
        exponent = bounded_square(pair_product(root, scale))
        log_density = (terms.peak - exponent[0]) + (terms.peak_low - exponent[1])
        if kind == NEARBY:
            log_density = log_density + log_other_turns(r, terms.decay)
    if "RAND" in flags:
        log_density = either(log_density, terms.random)
    log_p[:particles] = temperature * log_density
