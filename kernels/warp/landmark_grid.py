"""Search for the landmarks near the end point of a feature, book table 6.5.

Landmarks are stored in square buckets, row by row; start[i] is the first landmark of bucket i. A search visits the
buckets that a disc around the feature's end point touches, and evaluates the landmarks within the disc; landmarks
outside have a negligible density.
"""

import functools
import math
from types import SimpleNamespace

import warp as wp

from . import error_free, landmarks, line_feature
from .landmarks import (
    AXIS,
    BEARING_SPREAD,
    FARTHEST,
    HOLE,
    MOST,
    RADIUS,
    RANGE_AT,
    RANGE_SPREAD,
    REACH,
    SLACK,
)
from .prelude import precision


@functools.cache
def functions(flags):
    """Make the functions of the file for a set of flags."""
    types = precision(flags)
    real, vec2, vec4 = types.real, types.vec2, types.vec4
    add_term = error_free.functions(flags & {"FLOAT64"}).add_term
    density = landmarks.functions(flags & {"FLOAT64", "RANGE", "BEARING", "SIGNATURE", "FIELD"})
    offset, log_detection = density.offset, density.log_detection
    lines = line_feature.functions(flags & {"FLOAT64"})
    facing, overlaps, log_line = lines.facing, lines.overlaps, lines.log_line
    MARGINAL = "MARGINAL" in flags
    LINE = "LINE" in flags
    ZERO, ONE = real(0.0), real(1.0)
    NEVER = real(-math.inf)
    # A sum of densities is relative to one of them, until another is larger by a factor of e^RELATIVE.
    RELATIVE = real(4.0)
    WIDER = real(1.01)

    # Result of a search: the log density, of the likeliest landmark or with MARGINAL of all of them; the log density of
    # the likeliest one, and its index; and the sum of densities relative to log_p.
    @wp.struct
    class Match:
        log_p: real
        best: real
        chosen: wp.int32
        total: vec2

    @wp.func
    def bucket_at(position: real, size: real, count: wp.int32):
        """Return the row or column of the bucket at a position; positions outside get the nearest bucket."""
        return int(wp.clamp(wp.floor(position / size), ZERO, real(count - 1)))

    @wp.func
    def near(off: vec4, turned: vec4, feature: wp.array(dtype=real), base: wp.int32, most: real):
        """Return whether a landmark is in a feature's disc, within the limits of the sensor that the feature does not
        measure, and no farther from the end point than the square root of most.
        """
        reach = feature[base + REACH]
        radius = feature[base + RADIUS]
        hole = feature[base + HOLE]
        x = off[0] - reach * turned[0]
        y = off[2] - reach * turned[2]
        squared = off[0] * off[0] + off[2] * off[2]
        apart = x * x + y * y
        if apart > radius * radius or squared < hole * hole:
            return False
        # The bound most holds for a disc around the end point itself.
        if reach > ZERO and reach == feature[base + RANGE_AT] and apart > most:
            return False
        d = wp.sqrt(squared)
        return d <= feature[base + FARTHEST] and turned[0] * off[0] + turned[2] * off[2] >= feature[base + AXIS] * d

    @wp.func
    def squared_reach(exponent: real, feature: wp.array(dtype=real), base: wp.int32):
        """Return the square of the radius around a feature's end point outside which exponents are larger than
        exponent. Let r be the error of the range and b the error of the bearing: a landmark is sqrt(r^2 + 2 z (z +
        r) (1 - cos b)) away, and 2 (1 - cos b) is at most b^2. A factor and SLACK cover rounding errors of such
        distances.
        """
        squared = real(0.0)
        if exponent > ZERO:
            r = wp.sqrt(exponent) * feature[base + RANGE_SPREAD]
            b = wp.sqrt(exponent) * feature[base + BEARING_SPREAD]
            z = feature[base + RANGE_AT]
            squared = WIDER * (r * r + z * (z + r) * (b * b)) + feature[base + SLACK]
        return squared

    @wp.func
    def may_match(
        off: vec4, turned: vec4, feature: wp.array(dtype=real), base: wp.int32, normal: wp.array(dtype=vec4),
        signature: wp.array(dtype=vec4), j: wp.int32, most: real,
    ):  # fmt: skip
        """Return whether a feature may be landmark j: near its end point, or for lines similar in direction and
        overlapping.
        """
        may = bool(False)
        if LINE:
            may = overlaps(off, turned, feature, base, facing(normal[j], signature[j], turned), signature[j])
        else:
            may = near(off, turned, feature, base, most)
        return may

    @wp.func
    def log_match(
        off: vec4, turned: vec4, feature: wp.array(dtype=real), base: wp.int32, normal: wp.array(dtype=vec4),
        signature: wp.array(dtype=vec4), j: wp.int32, terms: wp.array(dtype=types.FeatureTerms),
        arcs: wp.array(dtype=vec2),
    ):  # fmt: skip
        """Return log(z_detect p(f | j)) of one feature at the offset of landmark j."""
        log_p = real(0.0)
        if LINE:
            seen = facing(normal[j], signature[j], turned)
            log_p = log_line(off, turned, feature, base, seen, signature[j], terms, arcs)
        else:
            log_p = log_detection(off, turned, feature, base, signature[j], terms, arcs)
        return log_p

    @wp.func
    def with_landmark(match: Match, log_p: real, j: wp.int32):
        """Update a match by one more landmark."""
        if MARGINAL:
            if wp.isinf(match.log_p):
                match.log_p = log_p
                match.total = vec2(wp.where(wp.isinf(log_p), ZERO, ONE), ZERO)
            elif log_p > match.log_p + RELATIVE:
                match.total = match.total * wp.exp(match.log_p - log_p) + vec2(ONE, ZERO)
                match.log_p = log_p
            else:
                match.total = add_term(match.total, wp.exp(log_p - match.log_p))
        if log_p > match.best:
            match.best = log_p
            match.chosen = j
        return match

    @wp.func
    def search(
        landmark: wp.array(dtype=vec4), normal: wp.array(dtype=vec4), signature: wp.array(dtype=vec4),
        start: wp.array(dtype=wp.int32), place: vec4, turned: vec4, feature: wp.array(dtype=real), base: wp.int32,
        terms: wp.array(dtype=types.FeatureTerms), arcs: wp.array(dtype=vec2), buckets: types.Buckets,
    ):  # fmt: skip
        """Return the match of a feature among the landmarks within its disc."""
        match = Match()
        match.log_p = NEVER
        match.best = NEVER
        match.chosen = -1
        match.total = vec2(ZERO, ZERO)
        reach = feature[base + REACH]
        radius = feature[base + RADIUS]
        if radius < ZERO:
            return match
        # Landmarks that cannot be likelier than the best so far are not evaluated.
        most = real(math.inf)
        x = place[0] + reach * turned[0]
        y = place[2] + reach * turned[2]
        left = bucket_at(x - radius, buckets.size, buckets.cols)
        right = bucket_at(x + radius, buckets.size, buckets.cols)
        high = bucket_at(y + radius, buckets.size, buckets.rows)
        row = bucket_at(y - radius, buckets.size, buckets.rows)
        while row <= high:
            j = start[row * buckets.cols + left]
            last = start[row * buckets.cols + right + 1]
            while j < last:
                off = offset(landmark[j], place)
                if may_match(off, turned, feature, base, normal, signature, j, most):
                    log_p = log_match(off, turned, feature, base, normal, signature, j, terms, arcs)
                    match = with_landmark(match, log_p, j)
                    if not MARGINAL and not LINE:
                        most = squared_reach(feature[base + MOST] - match.best, feature, base)
                j += 1
            row += 1
        if MARGINAL:
            if not wp.isinf(match.log_p):
                match.log_p = match.log_p + wp.log(match.total[0] + match.total[1])
        else:
            match.log_p = match.best
        return match

    return SimpleNamespace(**locals())
