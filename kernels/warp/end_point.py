"""The cell of the likelihood field's table in which a beam's end point lies, and the point's place within that cell."""

import warp as wp

from gpusense.interface.constants import FIELD_RING

from .error_free import pair_sum, two_product, two_sum
from .flags import BILINEAR, EXACT_EXPONENT, FLOAT64, INSIDE, TWO_PART_POINTS
from .prelude import by_device, fused
from .types import Window, real, vec2, vec4


@wp.func
def field_cell(col: wp.int32, row: wp.int32, window: Window):
    """Return the index of a cell of the padded table; far cells become ring cells."""
    c = wp.clamp(col, -FIELD_RING, window.cols + FIELD_RING - 1)
    r = wp.clamp(row, -FIELD_RING, window.rows + FIELD_RING - 1)
    return (r + FIELD_RING) * (window.cols + 2 * FIELD_RING) + c + FIELD_RING


one = "double" if FLOAT64 else "float"
half = f"static_cast<{one}>(0.5)"
ZERO, HALF, ONE = real(0.0), real(0.5), real(1.0)
MINUS_ONE = real(-1.0)
EDGE = real(2.0**-33)
# Adding and subtracting ROUNDING rounds to nearest; the bits of the sum hold the integer.
ROUNDING = real(1.5 * 2.0**52 if FLOAT64 else 1.5 * 2.0**23)
bits = wp.int64 if FLOAT64 else wp.int32
# The bits of ROUNDING: the bits of a sum with ROUNDING, less these, are an integer.
ROUNDING_BITS = wp.int32(0 if FLOAT64 else 0x4B400000)
multiply_add = fused(real)


@wp.func
def careful_offset(frac: vec2, a: vec2, b: vec2, c: vec2, d: vec2, sign: real):
    """Return frac + a b + sign c d to about twice the working precision; every factor is a sum of two numbers."""
    ab = two_product(a.x, b.x)
    cd = two_product(c.x, d.x)
    products = two_sum(ab.x, sign * cd.x)
    total = two_sum(products.x, frac.x)
    low = (a.x * b.y + a.y * b.x) + sign * (c.x * d.y + c.y * d.x)
    return vec2(total.x, ((ab.y + sign * cd.y) + (products.y + frac.y)) + (low + total.y))


@wp.func
def whole_cells(offset: vec2):
    """Return the whole cells below an offset of two parts, the remainder in [0, 1), and 1 minus it."""
    nearest = wp.floor(offset.x + HALF)
    past = vec2((offset.x - nearest) + offset.y, ZERO)
    if EXACT_EXPONENT:
        past = two_sum(offset.x - nearest, offset.y)
    below = past.x < ZERO
    size = vec2(wp.where(below, -past.x, past.x), wp.where(below, -past.y, past.y))
    other = vec2(ONE - size.x, ZERO)
    if EXACT_EXPONENT:
        other = pair_sum(vec2(ONE, ZERO), -size)
    under = past.x + EDGE < ZERO
    rest = vec2(wp.where(under, other.x, past.x), wp.where(under, other.y, past.y))
    to_next = vec2(wp.where(under, -past.x, other.x), wp.where(under, -past.y, other.y))
    return int(wp.where(under, nearest - ONE, nearest)), rest, to_next


# An end point: its cell as an offset from the pose's cell, and its place between the edges of that cell.
@wp.struct
class EndPoint:
    cell: wp.vec2i
    rest_x: vec2
    rest_y: vec2
    to_next_x: vec2
    to_next_y: vec2


@wp.func
def end_point(pose: vec4, pose_low: vec4, point: vec2, point_low: vec2, shift: real, guard: real):
    """Return the end point of a beam. point is the reading times the beam's (cos, sin), in cells."""
    end = EndPoint()
    x = vec2((pose.x - shift) + (pose.z * point.x - pose.w * point.y), ZERO)
    y = vec2((pose.y - shift) + (pose.w * point.x + pose.z * point.y), ZERO)
    if TWO_PART_POINTS:
        if BILINEAR:
            pass
        else:
            near = vec2(wp.floor(x.x), wp.floor(y.x))
            left = vec2(x.x - near.x, y.x - near.y)
            if left.x >= guard and left.y >= guard and left.x <= ONE - guard and left.y <= ONE - guard:
                end.cell = wp.vec2i(int(near.x), int(near.y))
                return end
        c = vec2(pose.z, pose_low.z)
        s = vec2(pose.w, pose_low.w)
        p = vec2(point.x, point_low.x)
        q = vec2(point.y, point_low.y)
        x = careful_offset(two_sum(pose.x, -shift) + vec2(ZERO, pose_low.x), c, p, s, q, MINUS_ONE)
        y = careful_offset(two_sum(pose.y, -shift) + vec2(ZERO, pose_low.y), s, p, c, q, ONE)
    col, rest_x, to_next_x = whole_cells(x)
    row, rest_y, to_next_y = whole_cells(y)
    end.cell = wp.vec2i(col, row)
    end.rest_x = rest_x
    end.rest_y = rest_y
    end.to_next_x = to_next_x
    end.to_next_y = to_next_y
    return end


# Return the largest distance from a cell's centre at which rounding certainly gives the cell: half a cell less the
# rounding errors of an end point. guard bounds them for rounded products, with 3.12 eps of the reading and 1.5 eps
# altogether. GPUs fuse products, and the errors are 2 eps and 1.6 eps.
@wp.func_native(by_device(f"{half} - static_cast<{one}>(0.6875) * guard", f"{half} - guard"))
def rounding_margin(guard: real) -> real: ...


@wp.func
def rounded_cell(lowered: vec4, point: vec2):
    """Nearest cell of an end point, plus ROUNDING_BITS: place, half a cell lower, is rounded to nearest."""
    x = multiply_add(lowered.z, point.x, multiply_add(-lowered.w, point.y, lowered.x))
    y = multiply_add(lowered.w, point.x, multiply_add(lowered.z, point.y, lowered.y))
    to_x = x + ROUNDING
    to_y = y + ROUNDING
    near = wp.vec2i(wp.int32(wp.cast(to_x, bits)), wp.int32(wp.cast(to_y, bits)))
    return near, wp.max(wp.abs(x - (to_x - ROUNDING)), wp.abs(y - (to_y - ROUNDING)))


@wp.func
def table_origin(origin: wp.vec2i, cols: wp.int32):
    """Return the origin for table_cell, from the pose's cell."""
    if INSIDE:
        stride = wp.uint32(cols + 2 * FIELD_RING)
        more = wp.uint32(FIELD_RING - ROUNDING_BITS)
        first = (wp.uint32(origin.y) + more) * stride + (wp.uint32(origin.x) + more)
        return wp.vec2i(wp.int32(first), wp.int32(stride))
    else:
        return wp.vec2i(origin.x - ROUNDING_BITS, origin.y - ROUNDING_BITS)


@wp.func
def table_cell(near: wp.vec2i, start: wp.vec2i, window: Window):
    """Return the index of the cell of rounded_cell in the padded table, from the origin of table_origin."""
    if INSIDE:
        return wp.int32(wp.uint32(near.y) * wp.uint32(start.y) + (wp.uint32(near.x) + wp.uint32(start.x)))
    else:
        return field_cell(start.x + near.x, start.y + near.y, window)
