"""Search for the landmarks near the end point of a feature, book table 6.5.

Landmarks are stored in square buckets, row by row; ``start[i]`` is the first landmark of bucket i. A search visits the
buckets that a disc around the feature's end point touches, and evaluates the landmarks within the disc; landmarks
outside have a negligible density.

Density of a line of a scan, in normal form, given a line of the map; ends do not count.

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

from gpusense.interface import feature_layout as at
from gpusense.interface import structs
from gpusense.reference.error_free import Pair, pair_product, pair_sum, two_sum
from gpusense.reference.landmarks import across, add_square, along, angle_pair, at_places, log_detection
from gpusense.reference.log_terms import Quad, offset

# Pairs of a particle and a landmark that are evaluated at once.
BLOCK_PAIRS = 1 << 18


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
    foot = feature[at.RANGE_AT] * sine - (normal[0] * off[2] - normal[2] * off[0])
    one, other = foot + feature[at.FIRST_END] * cosine, foot + feature[at.LAST_END] * cosine
    beside = (np.minimum(one, other) <= signature[:, 0]) & (np.maximum(one, other) >= -signature[:, 0])
    return (cosine >= feature[at.AXIS]) & beside


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
    dr = two_sum(feature[at.RANGE_AT], -d[0])
    dr = two_sum(dr[0], dr[1] + (feature[at.RANGE_LOW] - d[1]))
    mixed = pair_product(da, (np.asarray(feature[at.MIXED_SCALE]), np.asarray(feature[at.MIXED_SCALE_LOW])))
    plain = pair_product(dr, (np.asarray(feature[at.RANGE_SCALE]), np.asarray(feature[at.RANGE_SCALE_LOW])))
    exponent = add_square((zero, zero), da, feature[at.BEARING_SCALE], feature[at.BEARING_SCALE_LOW])
    exponent = add_square(exponent, pair_sum(mixed, plain), real.type(1), real.type(0))
    mass = distance_mass(d, feature[at.RANGE_SPREAD], signature, terms)
    log_p = (feature[at.PEAK] - exponent[0]) + (feature[at.PEAK_LOW] - exponent[1])
    return np.where(mass == 1, log_p, log_p - np.log(mass)).astype(real)


def bucket_at(position: np.ndarray, size: float, count: int) -> np.ndarray:
    """Return the row or column of the bucket at a position; positions outside get the nearest bucket."""
    return np.clip(np.floor(position / size), 0, count - 1).astype(np.int64)


def candidates(
    start: np.ndarray, place: Quad, turned: Quad, feature: np.ndarray, buckets: structs.Buckets
) -> tuple[np.ndarray, np.ndarray]:
    """Return runs of landmarks in the buckets that discs touch: (P, rows of buckets) first and last + 1."""
    reach, radius = feature[at.REACH], feature[at.RADIUS]
    x, y = place[0] + reach * turned[0], place[2] + reach * turned[2]
    left, right = bucket_at(x - radius, buckets.size, buckets.cols), bucket_at(x + radius, buckets.size, buckets.cols)
    low, high = bucket_at(y - radius, buckets.size, buckets.rows), bucket_at(y + radius, buckets.size, buckets.rows)
    row = low[:, None] + np.arange((high - low).max(initial=-1) + 1)
    inside = row <= high[:, None]
    row = np.minimum(row, buckets.rows - 1)
    first, last = start[row * buckets.cols + left[:, None]], start[row * buckets.cols + right[:, None] + 1]
    return first, np.where(inside, last, first)


def near(off: Quad, turned: Quad, feature: np.ndarray) -> np.ndarray:
    """Return whether landmarks are in a feature's disc, and within limits for components that it does not measure."""
    reach, radius, hole = feature[at.REACH], feature[at.RADIUS], feature[at.HOLE]
    x, y = off[0] - reach * turned[0], off[2] - reach * turned[2]
    squared = off[0] * off[0] + off[2] * off[2]
    seen = (x * x + y * y <= radius * radius) & (squared >= hole * hole)
    d = np.sqrt(squared)
    return seen & (d <= feature[at.FARTHEST]) & (turned[0] * off[0] + turned[2] * off[2] >= feature[at.AXIS] * d)


def may_match(flags, off, turned, feature, normal, signature, j):
    """Return whether features may be landmarks j: near an end point, or for lines of like direction and overlapping."""
    if "LINE" in flags:
        return overlaps(off, turned, feature, facing(normal[j], signature[j], turned), signature[j])
    return near(off, turned, feature)


def log_match(flags, off, turned, feature, normal, signature, j, terms, arcs):
    """Return ``log(z_detect p(f | j))`` of one feature at the offsets of landmarks j."""
    if "LINE" in flags:
        return log_line(off, turned, feature, facing(normal[j], signature[j], turned), signature[j], terms, arcs)
    return log_detection(flags, off, turned, feature, signature[j], terms, arcs)


def search(flags, landmark, normal, signature, start, place, turned, feature, terms, arcs, buckets):
    """Return per particle the log density, the log density of the likeliest landmark, and its index.

    The log density belongs to the likeliest landmark or, if MARGINAL, to all landmarks.
    """
    real, particles = place[0].dtype, len(place[0])
    best, chosen = np.full(particles, -np.inf, real), np.full(particles, -1, np.int32)
    if feature[at.RADIUS] < 0:
        return best, best, chosen
    log_p = best.copy()
    first, last = candidates(start, place, turned, feature, buckets)
    counts = (last - first).sum(axis=1)
    ends = np.cumsum(counts)
    begin = 0
    while begin < particles:
        # Take as many particles as have BLOCK_PAIRS candidates, at least one.
        base = ends[begin - 1] if begin else 0
        end = max(int(np.searchsorted(ends, base + BLOCK_PAIRS, side="right")), begin + 1)
        runs_first, runs = first[begin:end].ravel(), (last - first)[begin:end].ravel()
        n = np.repeat(np.arange(begin, end), counts[begin:end])
        j = np.arange(runs.sum()) + np.repeat(runs_first - (np.cumsum(runs) - runs), runs)
        placed, rotated = at_places(place, n), at_places(turned, n)
        off = offset(landmark[j], placed)
        kept = may_match(flags, off, rotated, feature, normal, signature, j)
        n, j = n[kept], j[kept]
        if len(n):
            off, rotated = at_places(off, kept), at_places(rotated, kept)
            value = log_match(flags, off, rotated, feature, normal, signature, j, terms, arcs)
            heads = np.flatnonzero(np.append(True, n[1:] != n[:-1]))
            holder, sizes = n[heads], np.diff(np.append(heads, len(n)))
            most = np.maximum.reduceat(value, heads)
            best[holder] = log_p[holder] = most
            # The first of equally likely landmarks.
            at_most = np.where(value == np.repeat(most, sizes), np.arange(len(n)), len(n))
            chosen[holder] = j[np.minimum.reduceat(at_most, heads)]
            if "MARGINAL" in flags:
                relative = np.where(np.isneginf(most), 0, most)
                total = np.add.reduceat(np.exp(value - np.repeat(relative, sizes)), heads, dtype=np.float64)
                log_p[holder] = np.where(np.isneginf(most), most, relative + np.log(np.maximum(total, 1))).astype(real)
        begin = end
    return log_p, best, np.where(np.isneginf(best), -1, chosen)
