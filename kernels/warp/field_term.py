"""Term of one reading in the likelihood field (book table 6.3)."""

import warp as wp

from .end_point import ROUNDING_BITS, EndPoint, end_point, field_cell, rounded_cell, table_cell
from .error_free import pair_product, pair_sum
from .flags import ALL_READINGS, BILINEAR, EXACT_EXPONENT, HIT, LINEAR, LOG_TABLE, RAND, SHAPES
from .hit_shape import shape_exponent
from .prelude import reader
from .shapes import shape_distance
from .types import Crowd, FieldTerms, Window, real, vec2, vec4

number_at = reader(real)
ZERO, ONE = real(0.0), real(1.0)
SHIFT = real(0.5 if BILINEAR else 0.0)


@wp.func
def between(weight_a: vec2, a: vec2, weight_b: vec2, b: vec2):
    """Return the weighted sum of a and b, all of two parts."""
    if EXACT_EXPONENT:
        return pair_sum(pair_product(weight_a, a), pair_product(weight_b, b))
    else:
        return vec2(weight_a.x * a.x + weight_b.x * b.x, ZERO)


@wp.func
def interpolated(four: vec4, end: EndPoint):
    """Interpolate between four distances, in two parts."""
    low = between(end.to_next_x, vec2(four.x, ZERO), end.rest_x, vec2(four.y, ZERO))
    high = between(end.to_next_x, vec2(four.z, ZERO), end.rest_x, vec2(four.w, ZERO))
    return between(end.to_next_y, low, end.rest_y, high)


@wp.func
def bilinear(table: wp.array(dtype=real), cell: wp.vec2i, end: EndPoint, window: Window):
    """Interpolate the distance between the four cell centres around an end point, in two parts."""
    four = vec4(
        number_at(table, field_cell(cell.x, cell.y, window)),
        number_at(table, field_cell(cell.x + 1, cell.y, window)),
        number_at(table, field_cell(cell.x, cell.y + 1, window)),
        number_at(table, field_cell(cell.x + 1, cell.y + 1, window)),
    )
    return interpolated(four, end)


@wp.func
def field_square(distance: vec2, terms: wp.array(dtype=FieldTerms)):
    """Return the exponent of a normal in two parts, since for a high peak exponent and log peak nearly cancel."""
    if EXACT_EXPONENT:
        return pair_product(pair_product(distance, distance), vec2(terms[0].square_scale, terms[0].square_scale_low))
    else:
        return vec2(distance.x * (distance.x * terms[0].square_scale), ZERO)


@wp.func
def field_exponent(distance: vec2, terms: wp.array(dtype=FieldTerms)):
    """Return the exponent of the density of a hit in two parts."""
    return shape_exponent(field_square(distance, terms), terms[0].shape_power, terms[0].shape_rate)


# Return log p of the distance from an end point to the nearest obstacle.
if LINEAR:

    @wp.func
    def log_field(distance: vec2, terms: wp.array(dtype=FieldTerms)):
        exponent = field_exponent(distance, terms)
        p = terms[0].rand_density  # 4: random measurement
        if HIT:
            # 1: correct range.
            p += terms[0].hit_peak * wp.exp(-exponent.x) * (ONE - exponent.y)
        return wp.log(p)

else:

    @wp.func
    def log_field(distance: vec2, terms: wp.array(dtype=FieldTerms)):
        exponent = field_exponent(distance, terms)
        hit = (terms[0].hit_peak - exponent.x) + (terms[0].hit_peak_low - exponent.y)
        if RAND:
            # The larger of two exponentials is 1.
            return wp.max(hit, terms[0].rand_density) + wp.log(ONE + wp.exp(-wp.abs(hit - terms[0].rand_density)))
        else:
            return hit


@wp.func
def end_in_cells(pose: vec4, point: vec2):
    """Return an end point relative to the pose's cell, in cells."""
    return vec2(pose.x + (pose.z * point.x - pose.w * point.y), pose.y + (pose.w * point.x + pose.z * point.y))


@wp.func
def reading_value(
    table: wp.array(dtype=real), origin: wp.vec2i, pose: vec4, low: vec4, point: vec2, point_low: vec2,
    terms: wp.array(dtype=FieldTerms), window: Window, guard: real, shapes: wp.array(dtype=real),
    world: wp.array(dtype=wp.vec2i), crowd: Crowd, n: wp.int32,
):  # fmt: skip
    """Return the term of one reading."""
    if ALL_READINGS:
        if wp.isnan(point.x):
            return ZERO
        if wp.isinf(point.x):
            return terms[0].z_max  # 3: failure
    end = end_point(pose, low, point, point_low, SHIFT, guard)
    cell = origin + end.cell
    if BILINEAR:
        distance = bilinear(table, cell, end, window)
        if SHAPES:
            near = crowd.side * shape_distance(shapes, world, crowd, n, origin, end_in_cells(pose, point))
            if near < distance.x:
                distance = vec2(near, ZERO)
        return log_field(distance, terms)
    else:
        value = number_at(table, field_cell(cell.x, cell.y, window))
        if LOG_TABLE:
            return value
        else:
            if SHAPES:
                near = crowd.side * shape_distance(shapes, world, crowd, n, origin, end_in_cells(pose, point))
                value = wp.where(near < value, near, value)
            return log_field(vec2(value, ZERO), terms)


@wp.func
def quick_value(table: wp.array(dtype=real), start_cell: wp.vec2i, lowered: vec4, to: vec2, far: real, window: Window):
    """Return the term of a reading by rounding alone, and the distance of the end point from the cell's centre."""
    if ALL_READINGS:
        is_range = wp.isfinite(to.x)
        near, off = rounded_cell(lowered, wp.where(is_range, to, vec2(ZERO, ZERO)))
        value = number_at(table, table_cell(near, start_cell, window))
        if not is_range:
            off = ZERO
            value = wp.where(wp.isinf(to.x), far, ZERO)
    else:
        near, off = rounded_cell(lowered, to)
        value = number_at(table, table_cell(near, start_cell, window))
    return value, off


@wp.func
def careful_value(
    table: wp.array(dtype=real), origin: wp.vec2i, lowered: vec4, sensor_pose: vec4, sensor_low: vec4, to: vec2,
    to_low: vec2, far: real, window: Window, guard: real, sure: real,
):  # fmt: skip
    """Return the term of a reading in a block where rounding is in doubt."""
    if ALL_READINGS:
        if wp.isnan(to.x):
            return ZERO
        if wp.isinf(to.x):
            return far
    near, off = rounded_cell(lowered, to)
    cell = wp.vec2i(near.x - ROUNDING_BITS, near.y - ROUNDING_BITS)
    if off > sure:
        exact = end_point(sensor_pose, sensor_low, to, to_low, ZERO, guard)
        cell = exact.cell
    return number_at(table, field_cell(origin.x + cell.x, origin.y + cell.y, window))
