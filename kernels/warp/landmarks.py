"""Density of one feature (range, bearing, signature) at one landmark, book table 6.4, with normalised components."""

import warp as wp

from gpusense.interface import feature_layout as at

from .error_free import pair_product, pair_sum, two_product, two_sum
from .flags import BEARING, FIELD, FLOAT64, RANGE, SIGNATURE
from .log_terms import distance_pair
from .types import FeatureTerms, real, vec2, vec4

# Arcs of i / 8, of a quarter and of half a turn, as sums of two numbers, are arcs[0] to arcs[10].
QUARTER_TURN, HALF_TURN = 9, 10
ZERO, HALF, ONE, TWO, STEPS = real(0.0), real(0.5), real(1.0), real(2.0), real(8.0)
# Below this distance [m] all bearings are equally likely.
ZERO_RANGE = real(1e-6)
# From here on the error function is 1 to the last bit.
ERF_ONE = real(6.0 if FLOAT64 else 4.0)
A1, A2, A3, A4 = real(-1.0 / 3.0), real(1.0 / 5.0), real(-1.0 / 7.0), real(1.0 / 9.0)
A5, A6, A7 = real(-1.0 / 11.0), real(1.0 / 13.0), real(-1.0 / 15.0)


@wp.func
def sensor_place(cell: wp.vec2i, pose: vec4, low: vec4, size: real):
    """Return the place of a sensor in metres from the origin of the buckets."""
    x = two_sum(real(cell[0]), pose[0])
    y = two_sum(real(cell[1]), pose[1])
    return vec4(size * x[0], size * (x[1] + low[0]), size * y[0], size * (y[1] + low[1]))


@wp.func
def direction(pose: vec4, pose_low: vec4, feature: wp.array(dtype=real), base: wp.int32):
    """Return the direction of a feature in the world: the heading, turned by the bearing."""
    c = feature[base + at.COSINE]
    s = feature[base + at.SINE]
    c_low = feature[base + at.COSINE_LOW]
    s_low = feature[base + at.SINE_LOW]
    cc = two_product(pose[2], c)
    ss = two_product(pose[3], s)
    cs = two_product(pose[2], s)
    sc = two_product(pose[3], c)
    x = two_sum(cc[0], -ss[0])
    y = two_sum(sc[0], cs[0])
    x_low = (pose[2] * c_low + pose_low[2] * c) - (pose[3] * s_low + pose_low[3] * s)
    y_low = (pose[3] * c_low + pose_low[3] * c) + (pose[2] * s_low + pose_low[2] * s)
    return vec4(x[0], x[1] + ((cc[1] - ss[1]) + x_low), y[0], y[1] + ((sc[1] + cs[1]) + y_low))


@wp.func
def across(off: vec4, turned: vec4):
    """Return the component of an offset to the left of a direction."""
    right = two_product(turned[0], off[2])
    left = two_product(turned[2], off[0])
    total = two_sum(right[0], -left[0])
    low = (turned[0] * off[3] + turned[1] * off[2]) - (turned[2] * off[1] + turned[3] * off[0])
    return vec2(total[0], total[1] + ((right[1] - left[1]) + low))


@wp.func
def along(off: vec4, turned: vec4):
    """Return the component of an offset along a direction."""
    x = two_product(turned[0], off[0])
    y = two_product(turned[2], off[2])
    total = two_sum(x[0], y[0])
    low = (turned[0] * off[1] + turned[1] * off[0]) + (turned[2] * off[3] + turned[3] * off[2])
    return vec2(total[0], total[1] + ((x[1] + y[1]) + low))


@wp.func
def arc_series(t: real):
    """Return arctan t / t - 1 for |t| <= 1 / 16, by its power series in t^2."""
    z = t * t
    return z * (A1 + z * (A2 + z * (A3 + z * (A4 + z * (A5 + z * (A6 + z * A7))))))


@wp.func
def angle_pair(side: vec2, ahead: vec2, arcs: wp.array(dtype=vec2)):
    """Return the angle of an offset in (-pi, pi]: the arc of the nearest slope i / 8, and a series for the rest."""
    a = ahead
    b = side
    if ahead[0] < ZERO:
        a = -ahead
    if side[0] < ZERO:
        b = -side
    steep = b[0] > a[0]
    num = b
    den = a
    if steep:
        num = a
        den = b
    safe = wp.where(den[0] > ZERO, den[0], ONE)
    step = wp.floor(num[0] / safe * STEPS + HALF)
    slope = step / STEPS
    less = two_product(slope, den[0])
    more = two_product(slope, num[0])
    first = two_sum(num[0], -less[0])
    bottom = two_sum(safe, more[0])
    top = two_sum(first[0], first[1] + ((num[1] - slope * den[1]) - less[1]))
    bottom_low = bottom[1] + ((den[1] + slope * num[1]) + more[1])
    t = top[0] / bottom[0]
    back = two_product(t, bottom[0])
    t_low = (((top[0] - back[0]) - back[1]) + (top[1] - t * bottom_low)) / bottom[0]
    base = arcs[int(step)]
    total = two_sum(base[0], t)
    arc = two_sum(total[0], total[1] + (base[1] + (t_low + t * arc_series(t))))
    if steep:
        arc = pair_sum(arcs[QUARTER_TURN], -arc)
    if ahead[0] < ZERO:
        arc = pair_sum(arcs[HALF_TURN], -arc)
    if side[0] < ZERO:
        arc = -arc
    return arc


@wp.func
def range_mass(d: vec2, scale: real, terms: wp.array(dtype=FeatureTerms)):
    """Return the mass of the normal around d on [0, range_max]; d is clamped to range_max."""
    below = wp.min(d[0], terms[0].range_max) * scale
    above = wp.max((terms[0].range_max - d[0]) + (terms[0].range_max_low - d[1]), ZERO) * scale
    if wp.min(below, above) > ERF_ONE:
        return ONE
    return HALF * (wp.erf(below) + wp.erf(above))


@wp.func
def field_mass(
    angle: vec2,
    upper: real,
    upper_low: real,
    scale: real,
    terms: wp.array(dtype=FeatureTerms),
    arcs: wp.array(dtype=vec2),
):
    """Return the mass of the normal around a landmark's bearing on the field of view."""
    half = arcs[HALF_TURN]
    half_turn = half[0]
    whole = TWO * half_turn
    field = terms[0].field_of_view
    left = (upper - angle[0]) + (upper_low - angle[1])
    if HALF * field - left > half_turn:
        left = left + whole
    elif left - HALF * field > half_turn:
        left = left - whole
    left = wp.clamp(left, ZERO, field)
    right = field - left
    mass = wp.erf(wp.min(left, half_turn) * scale) + wp.erf(wp.min(right, half_turn) * scale)
    if left > half_turn:
        mass = mass + (wp.erf(half_turn * scale) - wp.erf((whole - left) * scale))
    if right > half_turn:
        mass = mass + (wp.erf(half_turn * scale) - wp.erf((whole - right) * scale))
    return HALF * mass


@wp.func
def add_square(total: vec2, residual: vec2, scale: real, scale_low: real):
    """Add (residual * scale)^2 to an exponent, in two parts, since exponents and peaks may nearly cancel."""
    u = pair_product(residual, vec2(scale, scale_low))
    more = pair_sum(total, pair_product(u, u))
    # After an overflow there is no low part.
    return vec2(more[0], wp.where(wp.isfinite(more[1]), more[1], ZERO))


@wp.func
def log_detection(
    off: vec4, turned: vec4, feature: wp.array(dtype=real), base: wp.int32, signature: vec4,
    terms: wp.array(dtype=FeatureTerms), arcs: wp.array(dtype=vec2),
):  # fmt: skip
    """Return log(z_detect p(f | j)) of one feature at an offset; signature is (s_j, low part, -log m_s, 0)."""
    exponent = vec2(ZERO, ZERO)
    mass = real(1.0)
    norm = real(0.0)
    d = distance_pair(off)
    if RANGE:
        if feature[base + at.RANGE_SCALE] > ZERO:
            first = two_sum(d[0], -feature[base + at.RANGE_AT])
            r = two_sum(first[0], first[1] + (d[1] - feature[base + at.RANGE_LOW]))
            exponent = add_square(exponent, r, feature[base + at.RANGE_SCALE], feature[base + at.RANGE_SCALE_LOW])
            mass = range_mass(d, feature[base + at.RANGE_SCALE], terms)
    if BEARING:
        if feature[base + at.BEARING_SCALE] > ZERO:
            if d[0] > ZERO_RANGE:
                angle = angle_pair(across(off, turned), along(off, turned), arcs)
                exponent = add_square(
                    exponent, angle, feature[base + at.BEARING_SCALE], feature[base + at.BEARING_SCALE_LOW]
                )
                if FIELD:
                    mass = mass * field_mass(
                        angle,
                        feature[base + at.UPPER],
                        feature[base + at.UPPER_LOW],
                        feature[base + at.BEARING_SCALE],
                        terms,
                        arcs,
                    )
            else:
                # The density is 1 / field: the peak times zero_range_density and the scale.
                mass = mass * (terms[0].zero_range_density * feature[base + at.BEARING_SCALE])
    if SIGNATURE:
        if feature[base + at.SIGNATURE_SCALE] > ZERO:
            away = two_sum(feature[base + at.SIGNATURE_AT], -signature[0])
            s = two_sum(away[0], away[1] + (feature[base + at.SIGNATURE_LOW] - signature[1]))
            exponent = add_square(
                exponent, s, feature[base + at.SIGNATURE_SCALE], feature[base + at.SIGNATURE_SCALE_LOW]
            )
            norm = signature[2]
    log_p = (feature[base + at.PEAK] - exponent[0]) + ((feature[base + at.PEAK_LOW] - exponent[1]) + norm)
    if mass != ONE:
        log_p = log_p - wp.log(mass)
    return log_p
