"""Gradient and Gauss-Newton information of the interpolated likelihood field with respect to the pose."""

import warp as wp

from gpusense.interface.constants import GRADIENT_NUMBERS

from .end_point import EndPoint, end_point, field_cell
from .error_free import add_term, scaled_sum
from .field_term import bilinear, field_exponent, field_square, log_field
from .flags import ALL_READINGS, HIT, LINEAR, SCANS, TWO_PART_POINTS
from .hit_shape import shape_weight
from .prelude import kernel, reader, work_item
from .types import FieldTerms, Window, real, vec2, vec4

number_at = reader(real)
ZERO, ONE = real(0.0), real(1.0)


# Return the share of the hit density in the density at a distance.
if LINEAR:

    @wp.func
    def hit_share(distance: vec2, terms: wp.array(dtype=FieldTerms)):
        hit = ZERO
        if HIT:
            exponent = field_exponent(distance, terms)
            hit = terms[0].hit_peak * wp.exp(-exponent.x) * (ONE - exponent.y)
        return hit / (hit + terms[0].rand_density)

else:

    @wp.func
    def hit_share(distance: vec2, terms: wp.array(dtype=FieldTerms)):
        exponent = field_exponent(distance, terms)
        hit = (terms[0].hit_peak - exponent.x) + (terms[0].hit_peak_low - exponent.y)
        return ONE / (ONE + wp.exp(terms[0].rand_density - hit))


@wp.func
def distance_slope(table: wp.array(dtype=real), cell: wp.vec2i, end: EndPoint, window: Window):
    """Return the distance at an end point, and its derivatives in x and y, in metres per cell."""
    a = number_at(table, field_cell(cell.x, cell.y, window))
    b = number_at(table, field_cell(cell.x + 1, cell.y, window))
    c = number_at(table, field_cell(cell.x, cell.y + 1, window))
    d = number_at(table, field_cell(cell.x + 1, cell.y + 1, window))
    distance = bilinear(table, cell, end, window)
    x = end.to_next_y.x * (b - a) + end.rest_y.x * (d - c)
    y = end.to_next_x.x * (c - a) + end.rest_x.x * (d - b)
    return vec4(distance.x, distance.y, x, y)


Sums = wp.types.vector(length=9, dtype=real)
ZERO, HALF, TWO = real(0.0), real(0.5), real(2.0)


@wp.func
def add_slope(before: Sums, slope: vec4, weight: real, at: vec4, arm: vec2, resolution: real):
    """Return the sums with the gradient and information of a reading."""
    sums = before
    x = slope.z / resolution
    y = slope.w / resolution
    turn = slope.w * (at.z * arm.x - at.w * arm.y) - slope.z * (at.w * arm.x + at.z * arm.y)
    pull = -weight * slope.x
    sums[0] += pull * x
    sums[1] += pull * y
    sums[2] += pull * turn
    sums[3] += weight * x * x
    sums[4] += weight * x * y
    sums[5] += weight * x * turn
    sums[6] += weight * y * y
    sums[7] += weight * y * turn
    sums[8] += weight * turn * turn
    return sums


@wp.func
def add_readings(
    before: vec2, begun: Sums, table: wp.array(dtype=real), origin: wp.vec2i, at: vec4, low: vec4,
    point: wp.array(dtype=vec2), point_low: wp.array(dtype=vec2), terms: wp.array(dtype=FieldTerms), first: wp.int32,
    end_of_scan: wp.int32, apart: wp.int32, window: Window, guard: real, mount: vec2, resolution: real,
):  # fmt: skip
    """Return log p and the sums of add_slope with every apart-th reading of a scan from the first."""
    total = before
    sums = begun
    k = int(first)
    while k < end_of_scan:
        to = point[k]
        used = bool(True)
        if ALL_READINGS:
            used = wp.isfinite(to.x)
            if wp.isinf(to.x):
                total = add_term(total, terms[0].z_max)
        if used:
            to_low = vec2()
            if TWO_PART_POINTS:
                to_low = point_low[k]
            end = end_point(at, low, to, to_low, HALF, guard)
            slope = distance_slope(table, origin + end.cell, end, window)
            distance = vec2(slope.x, slope.y)
            total = add_term(total, log_field(distance, terms))
            bend = shape_weight(field_square(distance, terms).x, terms[0].shape_power, terms[0].shape_rate)
            weight = TWO * terms[0].square_scale * hit_share(distance, terms) * bend
            sums = add_slope(sums, slope, weight, at, to + mount, resolution)
        k += apart
    return total, sums


@kernel
def field_gradient(
    table, pose_cell, pose, pose_low, point, point_low, terms, start, constant_terms, gradient, window, particles,
    readings, guard, mount_x, mount_y, resolution, score, batch,
):  # fmt: skip
    """Write log p, gradient (3) and information (9) of poses in the grid's frame, each times the temperature."""
    n = work_item(wp.tid())
    if n >= particles:
        return
    begin = int(0)
    size = readings
    constant_term = score.constant_term
    if SCANS:
        scan = (n + batch.ahead) // batch.per_scan
        begin = start[scan]
        size = start[scan + 1] - begin
        constant_term = constant_terms[scan]
    low = vec4()
    if TWO_PART_POINTS:
        low = pose_low[n]
    total, sums = add_readings(
        vec2(constant_term, ZERO), Sums(), table, pose_cell[n], pose[n], low, point, point_low, terms, begin,
        begin + size, 1, window, guard, vec2(mount_x, mount_y), resolution,
    )  # fmt: skip
    out = n * GRADIENT_NUMBERS
    gradient[out] = scaled_sum(total, score.temperature)
    for i in range(6):
        gradient[out + 1 + i] = score.temperature * sums[i]
    # The other rows of the symmetric information matrix.
    gradient[out + 7] = score.temperature * sums[4]
    gradient[out + 8] = score.temperature * sums[6]
    gradient[out + 9] = score.temperature * sums[7]
    gradient[out + 10] = score.temperature * sums[5]
    gradient[out + 11] = score.temperature * sums[7]
    gradient[out + 12] = score.temperature * sums[8]
