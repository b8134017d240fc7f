"""Density of a line of a scan, in normal form, given a line of the map; ends do not count.

    p(f | j) = N((alpha, rho); (alpha_j, rho_j), C) / m

A line is the points with x cos alpha + y sin alpha = rho: alpha is the direction of its normal, away from the sensor,
and rho its distance (Siegwart, Nourbakhsh and Scaramuzza, *Introduction to Autonomous Mobile Robots*, 2011, section
4.7). alpha_j and rho_j describe the map's line at the particle; alpha - alpha_j is wrapped to (-pi, pi]. (alpha, rho)
and (alpha + pi, -rho) are one line: where a line of the map is seen from both sides, the normal nearer to the feature's
counts. m is the mass of the distance on [0, range_max]. By Cholesky's factor of C the exponent is (a da)^2 + (b da + c
dr)^2 with a = BEARING_SCALE, b = MIXED_SCALE and c = RANGE_SCALE. A feature may be a line of the map if its projection
overlaps that line: a scan shows only the visible part of a wall. A line of the map has its middle as landmark, its
normal away from the free side, and (half length, 1 if it is seen from both sides, 0, 0) as signature.
"""

from __future__ import annotations

import numpy as np
from scipy.special import erf

from gpusense.interface import structs
from gpusense.interface.feature_layout import (
    AXIS,
    BEARING_SCALE,
    BEARING_SCALE_LOW,
    FIRST_END,
    LAST_END,
    MIXED_SCALE,
    MIXED_SCALE_LOW,
    PEAK,
    PEAK_LOW,
    RANGE_AT,
    RANGE_LOW,
    RANGE_SCALE,
    RANGE_SCALE_LOW,
    RANGE_SPREAD,
)
from gpusense.reference.error_free import Pair, pair_product, pair_sum, two_sum
from gpusense.reference.landmarks import across, add_square, along, angle_pair
from gpusense.reference.offsets import Quad


def facing(normal: np.ndarray, signature: np.ndarray, turned: Quad) -> Quad:
    """Return the normals of lines of the map on the side that faces a feature's sensor."""
    x, x_low, y, y_low = normal.T
    back = (signature[:, 1] > 0) & (x * turned[0] + y * turned[2] < 0)
    sign = np.where(back, -1, 1).astype(normal.dtype)
    return sign * x, sign * x_low, sign * y, sign * y_low


def overlaps(off: Quad, turned: Quad, feature: np.ndarray, normal: Quad, signature: np.ndarray) -> np.ndarray:
    """Return whether a feature has about the direction of lines of the map, and overlaps them."""
    cosine = normal[0] * turned[0] + normal[2] * turned[2]
    sine = normal[0] * turned[2] - normal[2] * turned[0]
    foot = feature[RANGE_AT] * sine - (normal[0] * off[2] - normal[2] * off[0])
    one, other = foot + feature[FIRST_END] * cosine, foot + feature[LAST_END] * cosine
    beside = (np.minimum(one, other) <= signature[:, 0]) & (np.maximum(one, other) >= -signature[:, 0])
    return (cosine >= feature[AXIS]) & beside


def distance_mass(d: Pair, scale: float, signature: np.ndarray, terms: structs.FeatureTerms) -> np.ndarray:
    """Return the mass of the normal around lines' distances d on [0, range_max]; d is clamped to it.

    A line that is seen from both sides has two forms, (alpha_j, d) and (alpha_j + pi, -d): together they have the mass
    of d on [-range_max, range_max].
    """
    lower = np.where(signature[:, 1] > 0, -terms.range_max, 0).astype(d[0].dtype)
    width = terms.range_max - lower
    below = np.clip((d[0] - lower) + d[1], 0, width)
    above = np.clip((terms.range_max - d[0]) + (terms.range_max_low - d[1]), 0, width)
    return d[0].dtype.type(0.5) * (erf(below * scale) + erf(above * scale))


def log_line(
    off: Quad, turned: Quad, feature: np.ndarray, normal: Quad, signature: np.ndarray, terms: structs.FeatureTerms,
    arcs: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Return ``log(z_detect p(f | j))`` of one feature at the offsets of lines' middles."""
    real = off[0].dtype
    zero = np.zeros(len(off[0]), real)
    da = angle_pair(across(turned, normal), along(turned, normal), arcs)
    d = along(off, normal)
    dr = two_sum(feature[RANGE_AT], -d[0])
    dr = two_sum(dr[0], dr[1] + (feature[RANGE_LOW] - d[1]))
    mixed = pair_product(da, (np.asarray(feature[MIXED_SCALE]), np.asarray(feature[MIXED_SCALE_LOW])))
    plain = pair_product(dr, (np.asarray(feature[RANGE_SCALE]), np.asarray(feature[RANGE_SCALE_LOW])))
    exponent = add_square((zero, zero), da, feature[BEARING_SCALE], feature[BEARING_SCALE_LOW])
    exponent = add_square(exponent, pair_sum(mixed, plain), real.type(1), real.type(0))
    mass = distance_mass(d, feature[RANGE_SPREAD], signature, terms)
    log_p = (feature[PEAK] - exponent[0]) + (feature[PEAK_LOW] - exponent[1])
    return np.where(mass == 1, log_p, log_p - np.log(mass)).astype(real)
