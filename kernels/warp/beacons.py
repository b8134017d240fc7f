"""Density of ranges to known beacons, each truncated to [0, range_max] and mixed with a uniform one."""

import warp as wp

from gpusense.interface.constants import BEACON, STUDENT_T, TWO_NORMALS

from .error_free import add_term, pair_product, pair_sum, two_sum
from .flags import FLOAT64, RAND
from .log_terms import bounded_square, distance_pair, either, offset
from .prelude import kernel
from .types import BeaconTerms, real, vec2, vec4

ZERO, HALF, ONE = real(0.0), real(0.5), real(1.0)
# From this tangent on an arc is a quarter turn to the last bit; the tangent's square is still finite.
STEEPEST = real(1e18)
# From here on the error function is 1 to the last bit.
ERF_ONE = real(6.0 if FLOAT64 else 4.0)


@wp.func
def log_normal(residual: vec2, near: real, far: real, scale: vec2, peak: vec2):
    """Return the log of a truncated normal; near and far are the distances from its mean to the ends."""
    below = near * scale.x
    above = far * scale.x
    exponent = bounded_square(pair_product(residual, scale))
    untruncated = (peak.x - exponent.x) + (peak.y - exponent.y)
    if wp.min(below, above) <= ERF_ONE:
        untruncated = untruncated - wp.log(HALF * (wp.erf(below) + wp.erf(above)))
    return untruncated


@wp.func
def t_mass(any_t: real, terms: wp.array(dtype=BeaconTerms), series: wp.array(dtype=real), count: wp.int32):
    """Return the mass of a Student t between -t and t; t >= 0 is in units of its scale and sqrt(nu)."""
    t = wp.min(any_t, STEEPEST)
    cosine = ONE / wp.sqrt(ONE + t * t)
    square = cosine * cosine
    total = real(0.0)
    i = count - 1
    while i >= 0:
        total = total * square + series[i]
        i -= 1
    factor = t * cosine
    if terms[0].odd > ZERO:
        factor = factor * cosine
    return terms[0].arc * wp.atan(t) + factor * total


@wp.func
def log_student_t(
    residual: vec2, near: real, far: real, terms: wp.array(dtype=BeaconTerms), series: wp.array(dtype=real),
    count: wp.int32,
):  # fmt: skip
    """Return the log of a truncated Student t: -(nu + 1) / 2 log((1 + u^2 / nu) / k), where k includes the peak."""
    squared = bounded_square(pair_product(residual, vec2(terms[0].scale, terms[0].scale_low)))
    x = pair_sum(vec2(terms[0].offset, terms[0].offset_low), squared)
    below = t_mass(near * terms[0].t_scale, terms, series, count)
    above = t_mass(far * terms[0].t_scale, terms, series, count)
    return (terms[0].peak - terms[0].power * (wp.log(x.x) + x.y / x.x)) - wp.log(HALF * (below + above))


@wp.func
def log_range(
    d: vec2, beacon: wp.array(dtype=real), base: wp.int32, terms: wp.array(dtype=BeaconTerms),
    series: wp.array(dtype=real), count: wp.int32, kind: wp.int32,
):  # fmt: skip
    """Return log p of one range at a distance."""
    first = two_sum(d.x, -beacon[base + 4])
    r = two_sum(first.x, first.y + (d.y - beacon[base + 5]))
    near = wp.clamp(d.x + beacon[base + 6], ZERO, terms[0].range_max)
    far = terms[0].range_max - near
    log_p = real(0.0)
    if kind == STUDENT_T:
        log_p = log_student_t(r, near, far, terms, series, count)
    else:
        log_p = log_normal(
            r, near, far, vec2(terms[0].scale, terms[0].scale_low), vec2(terms[0].peak, terms[0].peak_low)
        )
    if kind == TWO_NORMALS:
        wide_scale = vec2(terms[0].wide_scale, terms[0].wide_scale_low)
        wide_peak = vec2(terms[0].wide_peak, terms[0].wide_peak_low)
        log_p = either(log_p, log_normal(r, near, far, wide_scale, wide_peak))
    if RAND:
        log_p = either(log_p, terms[0].random)
    return log_p


@kernel
def score_beacons(place, beacon, terms, series, log_p, particles, beacons, count, kind, temperature):
    """Sum log p of the ranges over beacons: one work-item takes a particle."""
    n = wp.tid()
    if n >= particles:
        return
    sensor = place[n]
    total = vec2(ZERO, ZERO)
    i = int(0)
    while i < beacons:
        base = BEACON * i
        at = vec4(beacon[base], beacon[base + 2], beacon[base + 1], beacon[base + 3])
        d = distance_pair(offset(at, sensor))
        total = add_term(total, log_range(d, beacon, base, terms, series, count, kind))
        i += 1
    log_p[n] = wp.where(wp.isinf(total.x), total.x, temperature * (total.x + total.y))
