"""Density of one feature (range, bearing, signature) at one landmark, book table 6.4, with normalised components.

    p(f | j) = N(r; d, sigma_r) / m_r  *  N(b; b_j, sigma_b) / m_b  *  N(s; s_j, sigma_s) / m_s

d and b_j are the landmark's distance and bearing from the sensor; differences of bearings are wrapped to (-pi, pi]. m
is the mass of a component on the measurable interval: [0, range_max], the field of view, the span of signatures.
Components that were not measured are left out. Positions, directions and quantities derived from them are sums of two
numbers, since a relative error of eps in a distance of 20 m is too large for a deviation of 1 cm.

A feature is FEATURE numbers, named in ``interface/feature_layout.py``. A place is (x, its low part, y, its low part),
and so are an offset and a direction.
"""

from __future__ import annotations

import numpy as np
from scipy.special import erf

from gpusense.interface import feature_layout as at
from gpusense.interface import structs
from gpusense.reference.error_free import Pair, pair_product, pair_sum, two_product, two_sum, where_pair
from gpusense.reference.log_terms import Quad, distance_pair

# Below this distance [m] all bearings are equally likely.
ZERO_RANGE = 1e-6
# arctan t = t + t^3 A(t^2), |t| <= 1 / 16, by its power series.
ARC_POWERS = tuple((-1.0) ** (i + 1) / (2 * i + 3) for i in range(7))


def negative_where(when: np.ndarray, a: Pair) -> Pair:
    """Negate pairs of numbers where ``when`` holds."""
    return where_pair(when, (-a[0], -a[1]), a)


def at_places(quad: Quad, places: np.ndarray | slice) -> Quad:
    """Select a subset of offsets, places or directions."""
    return quad[0][places], quad[1][places], quad[2][places], quad[3][places]


def sensor_place(pose_cell: np.ndarray, pose: np.ndarray, pose_low: np.ndarray, size: float) -> Quad:
    """Return the places of sensors in metres from the origin of the buckets; ``size`` is the side of a bucket."""
    x = two_sum(pose_cell[:, 0].astype(pose.dtype), pose[:, 0])
    y = two_sum(pose_cell[:, 1].astype(pose.dtype), pose[:, 1])
    return size * x[0], size * (x[1] + pose_low[:, 0]), size * y[0], size * (y[1] + pose_low[:, 1])


def direction(pose: np.ndarray, pose_low: np.ndarray, feature: np.ndarray) -> Quad:
    """Return the direction of a feature in the world: the heading, turned by the bearing."""
    (cosine, sine), (cosine_low, sine_low) = pose[:, 2:].T, pose_low[:, 2:].T
    c, s, c_low, s_low = feature[at.COSINE], feature[at.SINE], feature[at.COSINE_LOW], feature[at.SINE_LOW]
    cc, ss, cs, sc = (two_product(a, b) for a, b in ((cosine, c), (sine, s), (cosine, s), (sine, c)))
    x, y = two_sum(cc[0], -ss[0]), two_sum(sc[0], cs[0])
    x_low = x[1] + ((cc[1] - ss[1]) + ((cosine * c_low + cosine_low * c) - (sine * s_low + sine_low * s)))
    y_low = y[1] + ((sc[1] + cs[1]) + ((sine * c_low + sine_low * c) + (cosine * s_low + cosine_low * s)))
    return x[0], x_low, y[0], y_low


def across(off: Quad, turned: Quad) -> Pair:
    """Return the component of an offset to the left of a direction."""
    right, left = two_product(turned[0], off[2]), two_product(turned[2], off[0])
    total = two_sum(right[0], -left[0])
    low = (turned[0] * off[3] + turned[1] * off[2]) - (turned[2] * off[1] + turned[3] * off[0])
    return total[0], total[1] + ((right[1] - left[1]) + low)


def along(off: Quad, turned: Quad) -> Pair:
    """Return the component of an offset along a direction."""
    x, y = two_product(turned[0], off[0]), two_product(turned[2], off[2])
    total = two_sum(x[0], y[0])
    low = (turned[0] * off[1] + turned[1] * off[0]) + (turned[2] * off[3] + turned[3] * off[2])
    return total[0], total[1] + ((x[1] + y[1]) + low)


def arc_series(t: np.ndarray) -> np.ndarray:
    """Return ``arctan t / t - 1`` for |t| <= 1 / 16 by its power series in t^2."""
    real = t.dtype.type
    square, series = t * t, real(0)
    for power in ARC_POWERS[::-1]:
        series = series * square + real(power)
    return square * series


def angle_pair(side: Pair, ahead: Pair, arcs: np.ndarray) -> Pair:
    """Return the angle of an offset in (-pi, pi]: the arc of the nearest slope i / 8, and a series for the rest."""
    real = arcs.dtype.type
    a, b = negative_where(np.signbit(ahead[0]), ahead), negative_where(np.signbit(side[0]), side)
    steep = b[0] > a[0]
    num, den = where_pair(steep, a, b), where_pair(steep, b, a)
    safe = np.where(den[0] > 0, den[0], 1).astype(arcs.dtype)
    step = np.floor(num[0] / safe * real(at.ARC_STEPS) + real(0.5))
    slope = step / real(at.ARC_STEPS)
    less, more = two_product(slope, den[0]), two_product(slope, num[0])
    top, bottom = two_sum(num[0], -less[0]), two_sum(safe, more[0])
    top = two_sum(top[0], top[1] + ((num[1] - slope * den[1]) - less[1]))
    bottom_low = bottom[1] + ((den[1] + slope * num[1]) + more[1])
    t = top[0] / bottom[0]
    back = two_product(t, bottom[0])
    t_low = (((top[0] - back[0]) - back[1]) + (top[1] - t * bottom_low)) / bottom[0]
    base = arcs[step.astype(np.int32)]
    total = two_sum(base[:, 0], t)
    arc = two_sum(total[0], total[1] + (base[:, 1] + (t_low + t * arc_series(t))))
    for when, whole in ((steep, arcs[at.ARC_STEPS + 1]), (np.signbit(ahead[0]), arcs[at.ARC_STEPS + 2])):
        arc = where_pair(when, pair_sum((whole[0], whole[1]), (-arc[0], -arc[1])), arc)
    return negative_where(np.signbit(side[0]), arc)


def range_mass(d: Pair, scale: float, terms: structs.FeatureTerms) -> np.ndarray:
    """Return the mass of the normal around d on [0, range_max]; d is clamped to range_max."""
    above = np.maximum((terms.range_max - d[0]) + (terms.range_max_low - d[1]), 0)
    return d[0].dtype.type(0.5) * (erf(np.minimum(d[0], terms.range_max) * scale) + erf(above * scale))


def field_mass(angle: Pair, upper: float, upper_low: np.floating, scale: np.floating, terms: structs.FeatureTerms,
               arcs: np.ndarray) -> np.ndarray:  # fmt: skip
    """Return the mass of the normal around a landmark's bearing on the field of view.

    The bearing is clamped to the ends of the field. Parts of the field more than half a turn away from the landmark are
    nearer in the other direction.
    """
    half, whole = arcs[at.ARC_STEPS + 2, 0], 2 * arcs[at.ARC_STEPS + 2, 0]
    left = (upper - angle[0]) + (upper_low - angle[1])
    middle = terms.field_of_view / 2
    left = np.where(middle - left > half, left + whole, np.where(middle - left < -half, left - whole, left))
    left = np.clip(left, 0, terms.field_of_view)
    right = terms.field_of_view - left
    mass = erf(np.minimum(left, half) * scale) + erf(np.minimum(right, half) * scale)
    for side in (left, right):
        mass = mass + np.where(side > half, erf(half * scale) - erf((whole - side) * scale), 0)
    return angle[0].dtype.type(0.5) * mass


def add_square(total: Pair, residual: Pair, scale: float, scale_low: np.floating) -> Pair:
    """Add (residual * scale)^2 to an exponent, in two parts, since exponents and peaks may nearly cancel."""
    u = pair_product(residual, (np.asarray(scale), np.asarray(scale_low)))
    more = pair_sum(total, pair_product(u, u))
    # After an overflow there is no low part.
    return more[0], np.where(np.isfinite(more[1]), more[1], 0).astype(more[1].dtype)


def log_detection(flags, off, turned, feature, signature, terms, arcs):
    """Return ``log(z_detect p(f | j))`` of one feature at each offset; signature is (s_j, low part, -log m_s, 0)."""
    real = off[0].dtype
    zero = np.zeros(len(off[0]), real)
    exponent, mass, norm = (zero, zero), np.ones(len(zero), real), zero
    d = distance_pair(off)
    if "RANGE" in flags and feature[at.RANGE_SCALE] > 0:
        r = two_sum(d[0], -feature[at.RANGE_AT])
        r = two_sum(r[0], r[1] + (d[1] - feature[at.RANGE_LOW]))
        exponent = add_square(exponent, r, feature[at.RANGE_SCALE], feature[at.RANGE_SCALE_LOW])
        mass = mass * range_mass(d, feature[at.RANGE_SCALE], terms)
    if "BEARING" in flags and feature[at.BEARING_SCALE] > 0:
        angle = angle_pair(across(off, turned), along(off, turned), arcs)
        squared = add_square(exponent, angle, feature[at.BEARING_SCALE], feature[at.BEARING_SCALE_LOW])
        # At zero range the density is 1 / field: the peak times zero_range_density and the scale.
        has_bearing = d[0] > real.type(ZERO_RANGE)
        exponent = where_pair(has_bearing, squared, exponent)
        mass_in_field = real.type(1)
        if "FIELD" in flags:
            mass_in_field = field_mass(
                angle, feature[at.UPPER], feature[at.UPPER_LOW], feature[at.BEARING_SCALE], terms, arcs
            )
        mass = mass * np.where(has_bearing, mass_in_field, terms.zero_range_density * feature[at.BEARING_SCALE])
    if "SIGNATURE" in flags and feature[at.SIGNATURE_SCALE] > 0:
        s = two_sum(feature[at.SIGNATURE_AT], -signature[:, 0])
        s = two_sum(s[0], s[1] + (feature[at.SIGNATURE_LOW] - signature[:, 1]))
        exponent = add_square(exponent, s, feature[at.SIGNATURE_SCALE], feature[at.SIGNATURE_SCALE_LOW])
        norm = signature[:, 2]
    log_p = (feature[at.PEAK] - exponent[0]) + ((feature[at.PEAK_LOW] - exponent[1]) + norm)
    return np.where(mass == 1, log_p, log_p - np.log(mass)).astype(real)
