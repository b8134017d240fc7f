"""Probability of contact from the distance of a robot's outline to the nearest obstacle."""

import warp as wp

from .end_point import end_point as find_end_point
from .end_point import field_cell
from .error_free import pair_product, two_product, two_sum
from .flags import FLOAT64, TWO_PART_POINTS
from .log_terms import bounded_square, either
from .prelude import kernel
from .types import ContactTerms, real, vec2, vec4

NO_OBSTACLE = 0x7FFFFFFF
SERIES = 12
ZERO, HALF, ONE, TWO = real(0.0), real(0.5), real(1.0), real(2.0)
HIGH_PART = real(4096.0)
# Gap in cells where there is no obstacle.
FAR_CELLS = real(1e9)
LOG_TWO_ROOT_PI = real(1.2655121234846454)
LARGE = real(10.0 if FLOAT64 else 6.0)


@wp.func
def gap(squared: wp.int32, terms: wp.array(dtype=ContactTerms)):
    """Return the gap between outline and obstacle, negative where they overlap; squared is in cells."""
    whole = two_sum(real(squared >> 12) * HIGH_PART, real(squared & 4095))
    d = wp.sqrt(whole.x)
    dd = two_product(d, d)
    cells = vec2(d, ZERO)
    if d > ZERO:
        cells = vec2(d, ((whole.x - dd.x) + (whole.y - dd.y)) / (TWO * d))
    if squared == NO_OBSTACLE:
        cells = vec2(FAR_CELLS, ZERO)
    away = pair_product(cells, vec2(terms[0].side, terms[0].side_low))
    left = two_sum(away.x, -terms[0].reach)
    return two_sum(left.x, left.y + (away.y - terms[0].reach_low))


@wp.func
def log_above(x: vec2):
    """Return log(erfc(x) / 2), by an asymptotic series where erfc nearly underflows."""
    log_half = real(0.0)
    if x.x > LARGE:
        t = HALF / (x.x * x.x)
        series = real(1.0)
        n = SERIES
        while n > 0:
            series = ONE - real(2 * n - 1) * t * series
            n -= 1
        square = bounded_square(x)
        log_half = -square.x - (wp.log(x.x) + LOG_TWO_ROOT_PI - wp.log(series) + square.y)
    else:
        log_half = wp.log(HALF * wp.erfc(x.x))
    return log_half


@wp.func
def log_bump(squared: wp.int32, pressed: wp.int32, terms: wp.array(dtype=ContactTerms)):
    """Return the log probability that a segment is pressed, or that it is not."""
    x = pair_product(gap(squared, terms), vec2(terms[0].scale, terms[0].scale_low))
    hit = terms[0].log_missed
    no_hit = terms[0].log_quiet
    if pressed != 0:
        hit = terms[0].log_contact
        no_hit = terms[0].log_false
    return either(hit + log_above(x), no_hit + log_above(-x))


@kernel
def score_contact(
    table, pose_cell, pose, pose_low, point, point_low, start, pressed, terms, log_p, window, particles, segments,
    guard, temperature,
):  # fmt: skip
    """Sum log p over segments: one work-item takes a particle."""
    n = wp.tid()
    if n >= particles:
        return
    sensor_pose = pose[n]
    low = vec4()
    if TWO_PART_POINTS:
        low = pose_low[n]
    total = real(0.0)
    s = int(0)
    while s < segments:
        nearest = NO_OBSTACLE
        i = start[s]
        while i < start[s + 1]:
            end = find_end_point(sensor_pose, low, point[i], point_low[i], ZERO, guard)
            at = pose_cell[n] + end.cell
            nearest = wp.min(nearest, table[field_cell(at.x, at.y, window)])
            i += 1
        total += log_bump(nearest, pressed[s], terms)
        s += 1
    log_p[n] = temperature * total
