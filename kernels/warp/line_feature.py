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

import functools
from types import SimpleNamespace

import warp as wp

from . import error_free, landmarks
from .landmarks import (
    AXIS,
    BEARING_SCALE,
    BEARING_SCALE_LOW,
    PEAK,
    PEAK_LOW,
    RANGE_AT,
    RANGE_LOW,
    RANGE_SCALE,
    RANGE_SCALE_LOW,
    RANGE_SPREAD,
)
from .prelude import precision

# The factor of the angle in the second exponent; places of the ends along the line, from the foot of the normal.
MIXED_SCALE, MIXED_SCALE_LOW = wp.constant(12), wp.constant(13)
FIRST_END, LAST_END = wp.constant(17), wp.constant(18)


@functools.cache
def functions(flags):
    """Make the functions of the file for a set of flags."""
    types = precision(flags)
    real, vec2, vec4 = types.real, types.vec2, types.vec4
    exact = error_free.functions(flags & {"FLOAT64"})
    two_sum, pair_sum, pair_product = exact.two_sum, exact.pair_sum, exact.pair_product
    density = landmarks.functions(flags & {"FLOAT64"})
    across, along, angle_pair = density.across, density.along, density.angle_pair
    add_square = density.add_square
    ZERO, HALF, ONE = real(0.0), real(0.5), real(1.0)
    # From here on the error function is 1 to the last bit.
    ERF_ONE = real(6.0 if "FLOAT64" in flags else 4.0)

    @wp.func
    def facing(normal: vec4, signature: vec4, turned: vec4):
        """Return the normal of a line of the map on the side that faces a feature's sensor."""
        seen = normal
        if signature[1] > ZERO and normal[0] * turned[0] + normal[2] * turned[2] < ZERO:
            seen = -normal
        return seen

    @wp.func
    def overlaps(off: vec4, turned: vec4, feature: wp.array(dtype=real), base: wp.int32, normal: vec4, signature: vec4):
        """Return whether a feature has about the direction of a line of the map, and overlaps it."""
        cosine = normal[0] * turned[0] + normal[2] * turned[2]
        sine = normal[0] * turned[2] - normal[2] * turned[0]
        foot = feature[base + RANGE_AT] * sine - (normal[0] * off[2] - normal[2] * off[0])
        one = foot + feature[base + FIRST_END] * cosine
        other = foot + feature[base + LAST_END] * cosine
        beside = wp.min(one, other) <= signature[0] and wp.max(one, other) >= -signature[0]
        return cosine >= feature[base + AXIS] and beside

    @wp.func
    def distance_mass(d: vec2, scale: real, signature: vec4, terms: wp.array(dtype=types.FeatureTerms)):
        """Return the mass of the normal around a line's distance d on [0, range_max]; d is clamped to it.

        A line that is seen from both sides has two forms, (alpha_j, d) and (alpha_j + pi, -d): together they have the
        mass of d on [-range_max, range_max].
        """
        lower = real(0.0)
        if signature[1] > ZERO:
            lower = -terms[0].range_max
        width = terms[0].range_max - lower
        below = wp.clamp((d[0] - lower) + d[1], ZERO, width) * scale
        above = wp.clamp((terms[0].range_max - d[0]) + (terms[0].range_max_low - d[1]), ZERO, width) * scale
        if wp.min(below, above) > ERF_ONE:
            return ONE
        return HALF * (wp.erf(below) + wp.erf(above))

    @wp.func
    def log_line(
        off: vec4, turned: vec4, feature: wp.array(dtype=real), base: wp.int32, normal: vec4, signature: vec4,
        terms: wp.array(dtype=types.FeatureTerms), arcs: wp.array(dtype=vec2),
    ):  # fmt: skip
        """Return log(z_detect p(f | j)) of one feature at the offset of a line's middle."""
        da = angle_pair(across(turned, normal), along(turned, normal), arcs)
        d = along(off, normal)
        first = two_sum(feature[base + RANGE_AT], -d[0])
        dr = two_sum(first[0], first[1] + (feature[base + RANGE_LOW] - d[1]))
        mixed = pair_product(da, vec2(feature[base + MIXED_SCALE], feature[base + MIXED_SCALE_LOW]))
        plain = pair_product(dr, vec2(feature[base + RANGE_SCALE], feature[base + RANGE_SCALE_LOW]))
        exponent = add_square(vec2(ZERO, ZERO), da, feature[base + BEARING_SCALE], feature[base + BEARING_SCALE_LOW])
        exponent = add_square(exponent, pair_sum(mixed, plain), ONE, ZERO)
        mass = distance_mass(d, feature[base + RANGE_SPREAD], signature, terms)
        log_p = (feature[base + PEAK] - exponent[0]) + (feature[base + PEAK_LOW] - exponent[1])
        if mass != ONE:
            log_p = log_p - wp.log(mass)
        return log_p

    return SimpleNamespace(**locals())
