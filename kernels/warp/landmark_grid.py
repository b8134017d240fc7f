"""Search for the landmarks near the end point of a feature, book table 6.5."""

import math

import warp as wp

from gpusense.interface import feature_layout as at

from .error_free import add_term, pair_product, pair_sum, two_sum
from .flags import FLOAT64, LINE, MARGINAL
from .landmarks import across, add_square, along, angle_pair, log_detection
from .log_terms import offset
from .types import Buckets, FeatureTerms, real, vec2, vec4

ZERO, HALF, ONE = real(0.0), real(0.5), real(1.0)
NEVER = real(-math.inf)
# A sum of densities is relative to one of them, until another is larger by a factor of e^RELATIVE.
RELATIVE = real(4.0)
WIDER = real(1.01)
# From here on the error function is 1 to the last bit.
ERF_ONE = real(6.0 if FLOAT64 else 4.0)


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
    foot = feature[base + at.RANGE_AT] * sine - (normal[0] * off[2] - normal[2] * off[0])
    one = foot + feature[base + at.FIRST_END] * cosine
    other = foot + feature[base + at.LAST_END] * cosine
    beside = wp.min(one, other) <= signature[0] and wp.max(one, other) >= -signature[0]
    return cosine >= feature[base + at.AXIS] and beside


@wp.func
def distance_mass(d: vec2, scale: real, signature: vec4, terms: wp.array(dtype=FeatureTerms)):
    """Return the mass of the normal around a line's distance d on [0, range_max]; d is clamped to it."""
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
    terms: wp.array(dtype=FeatureTerms), arcs: wp.array(dtype=vec2),
):  # fmt: skip
    """Return log(z_detect p(f | j)) of one feature at the offset of a line's middle."""
    da = angle_pair(across(turned, normal), along(turned, normal), arcs)
    d = along(off, normal)
    first = two_sum(feature[base + at.RANGE_AT], -d[0])
    dr = two_sum(first[0], first[1] + (feature[base + at.RANGE_LOW] - d[1]))
    mixed = pair_product(da, vec2(feature[base + at.MIXED_SCALE], feature[base + at.MIXED_SCALE_LOW]))
    plain = pair_product(dr, vec2(feature[base + at.RANGE_SCALE], feature[base + at.RANGE_SCALE_LOW]))
    exponent = add_square(vec2(ZERO, ZERO), da, feature[base + at.BEARING_SCALE], feature[base + at.BEARING_SCALE_LOW])
    exponent = add_square(exponent, pair_sum(mixed, plain), ONE, ZERO)
    mass = distance_mass(d, feature[base + at.RANGE_SPREAD], signature, terms)
    log_p = (feature[base + at.PEAK] - exponent[0]) + (feature[base + at.PEAK_LOW] - exponent[1])
    if mass != ONE:
        log_p = log_p - wp.log(mass)
    return log_p


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
    """Return whether a landmark is in a feature's disc, and within limits that the feature does not measure."""
    reach = feature[base + at.REACH]
    radius = feature[base + at.RADIUS]
    hole = feature[base + at.HOLE]
    x = off[0] - reach * turned[0]
    y = off[2] - reach * turned[2]
    squared = off[0] * off[0] + off[2] * off[2]
    apart = x * x + y * y
    if apart > radius * radius or squared < hole * hole:
        return False
    # The bound most holds for a disc around the end point itself.
    if reach > ZERO and reach == feature[base + at.RANGE_AT] and apart > most:
        return False
    d = wp.sqrt(squared)
    return d <= feature[base + at.FARTHEST] and turned[0] * off[0] + turned[2] * off[2] >= feature[base + at.AXIS] * d


@wp.func
def squared_reach(exponent: real, feature: wp.array(dtype=real), base: wp.int32):
    """Return the square of the radius around a feature's end point outside which exponents are larger than exponent."""
    squared = real(0.0)
    if exponent > ZERO:
        r = wp.sqrt(exponent) * feature[base + at.RANGE_SPREAD]
        b = wp.sqrt(exponent) * feature[base + at.BEARING_SPREAD]
        z = feature[base + at.RANGE_AT]
        squared = WIDER * (r * r + z * (z + r) * (b * b)) + feature[base + at.SLACK]
    return squared


@wp.func
def may_match(
    off: vec4, turned: vec4, feature: wp.array(dtype=real), base: wp.int32, normal: wp.array(dtype=vec4),
    signature: wp.array(dtype=vec4), j: wp.int32, most: real,
):  # fmt: skip
    """Return whether a feature may be landmark j."""
    may = bool(False)
    if LINE:
        may = overlaps(off, turned, feature, base, facing(normal[j], signature[j], turned), signature[j])
    else:
        may = near(off, turned, feature, base, most)
    return may


@wp.func
def log_match(
    off: vec4, turned: vec4, feature: wp.array(dtype=real), base: wp.int32, normal: wp.array(dtype=vec4),
    signature: wp.array(dtype=vec4), j: wp.int32, terms: wp.array(dtype=FeatureTerms), arcs: wp.array(dtype=vec2),
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
    terms: wp.array(dtype=FeatureTerms), arcs: wp.array(dtype=vec2), buckets: Buckets,
):  # fmt: skip
    """Return the match of a feature among the landmarks within its disc."""
    match = Match()
    match.log_p = NEVER
    match.best = NEVER
    match.chosen = -1
    match.total = vec2(ZERO, ZERO)
    reach = feature[base + at.REACH]
    radius = feature[base + at.RADIUS]
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
                    most = squared_reach(feature[base + at.MOST] - match.best, feature, base)
            j += 1
        row += 1
    if MARGINAL:
        if not wp.isinf(match.log_p):
            match.log_p = match.log_p + wp.log(match.total[0] + match.total[1])
    else:
        match.log_p = match.best
    return match
