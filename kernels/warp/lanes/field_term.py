"""Terms of a block of readings of the interpolated field: field_term.py in loops that become vectors of 16 readings."""

import warp as wp

from gpusense.interface.constants import BLOCK_TERMS, FIELD_RING

from ..end_point import EndPoint, end_point
from ..field_term import field_square, interpolated
from ..flags import EXACT_EXPONENT, FLOAT64, HIT, LINEAR, RAND
from ..hit_shape import shape_exponent
from ..prelude import exact_fma, field_readers, fuses, reader
from ..types import FieldTerms, Window, real, vec2, vec4
from .math import exp_lanes, log_lanes

double = wp.float64
block_numbers = wp.types.vector(length=BLOCK_TERMS, dtype=real)
block_cells = wp.types.vector(length=BLOCK_TERMS, dtype=wp.int32)
rest = double if EXACT_EXPONENT else real
block_rests = wp.types.vector(length=BLOCK_TERMS, dtype=rest)
multiply_add = exact_fma(double)
number_at, point_at, term_of = reader(real), reader(vec2), field_readers(FieldTerms)
ZERO, HALF, ONE = real(0.0), real(0.5), real(1.0)
DOUBLE_HALF, DOUBLE_ONE = double(0.5), double(1.0)
# 1.5 * 2^52: a sum of it and an integer of either sign has the integer in its last 32 bits.
INTEGERS = double(6755399441055744.0)


@wp.func
def multiplied_lanes(a: double, b: double, c: double):
    """Return a b + c, rounded once where the processor has a fused multiply-add."""
    if fuses():
        return multiply_add(a, b, c)
    return a * b + c


@wp.func
def table_place(col: wp.int32, row: wp.int32, window: Window):
    """Return the index of the cell of an end point in the padded table. Both cells of the ring hold the same value, so
    four neighbours are read even beyond an edge.
    """
    c = wp.clamp(col + FIELD_RING, 0, window.cols + (2 * FIELD_RING - 2))
    r = wp.clamp(row + FIELD_RING, 0, window.rows + (2 * FIELD_RING - 2))
    return r * (window.cols + 2 * FIELD_RING) + c


@wp.func
def block_distances(cells: block_cells, table: wp.array(dtype=real), window: Window):
    """Read the distances of four neighbours. Look-ups keep a loop scalar."""
    a, b, c, d = block_numbers(), block_numbers(), block_numbers(), block_numbers()
    stride = window.cols + 2 * FIELD_RING
    i = int(0)
    while i < BLOCK_TERMS:
        at = cells[i]
        a[i] = number_at(table, at)
        b[i] = number_at(table, at + 1)
        c[i] = number_at(table, at + stride)
        d[i] = number_at(table, at + stride + 1)
        i += 1
    return a, b, c, d


# Return the exponents of a block's densities in two parts.
if FLOAT64:

    @wp.func
    def block_exponents(
        table: wp.array(dtype=real), origin: wp.vec2i, pose: vec4, low: vec4, point: wp.array(dtype=vec2),
        point_low: wp.array(dtype=vec2), terms: wp.array(dtype=FieldTerms), window: Window,
        begin: wp.int32, count: wp.int32,
    ):  # fmt: skip
        cells = block_cells()
        rest_x, rest_y, next_x, next_y = block_numbers(), block_numbers(), block_numbers(), block_numbers()
        rest_x_low, rest_y_low = block_numbers(), block_numbers()
        next_x_low, next_y_low = block_numbers(), block_numbers()
        exponent, exponent_low = block_numbers(), block_numbers()
        i = int(0)
        while i < count:
            end = end_point(pose, low, point_at(point, begin + i), vec2(), HALF, ZERO)
            cells[i] = table_place(origin.x + end.cell.x, origin.y + end.cell.y, window)
            rest_x[i] = end.rest_x.x
            rest_y[i] = end.rest_y.x
            next_x[i] = end.to_next_x.x
            next_y[i] = end.to_next_y.x
            if EXACT_EXPONENT:
                rest_x_low[i] = end.rest_x.y
                rest_y_low[i] = end.rest_y.y
                next_x_low[i] = end.to_next_x.y
                next_y_low[i] = end.to_next_y.y
            i += 1
        a, b, c, d = block_distances(cells, table, window)
        i = int(0)
        while i < BLOCK_TERMS:
            at = EndPoint()
            at.rest_x = vec2(rest_x[i], rest_x_low[i])
            at.rest_y = vec2(rest_y[i], rest_y_low[i])
            at.to_next_x = vec2(next_x[i], next_x_low[i])
            at.to_next_y = vec2(next_y[i], next_y_low[i])
            square = field_square(interpolated(vec4(a[i], b[i], c[i], d[i]), at), terms)
            parts_of = shape_exponent(square, term_of.shape_power(terms), term_of.shape_rate(terms))
            exponent[i] = parts_of.x
            exponent_low[i] = parts_of.y
            i += 1
        return exponent, exponent_low

else:

    @wp.func
    def square_lanes(four: vec4, rest_x: rest, rest_y: rest, factor: rest):
        """Return the square of an interpolated distance over 2 sigma^2 in two parts; factor is 1 / (2 sigma^2)."""
        left = rest(four.x)
        above = rest(four.z)
        if EXACT_EXPONENT:
            near = left + rest_x * (rest(four.y) - left)
            far = above + rest_x * (rest(four.w) - above)
            distance = near + rest_y * (far - near)
            square = distance * distance * factor
            return vec2(real(square), real(square - rest(real(square))))
        else:
            to_next_x = ONE - rest_x
            near = to_next_x * left + rest_x * four.y
            far = to_next_x * above + rest_x * four.w
            distance = (ONE - rest_y) * near + rest_y * far
            return vec2(distance * (distance * factor), ZERO)

    @wp.func
    def block_exponents(
        table: wp.array(dtype=real), origin: wp.vec2i, pose: vec4, low: vec4, point: wp.array(dtype=vec2),
        point_low: wp.array(dtype=vec2), terms: wp.array(dtype=FieldTerms), window: Window,
        begin: wp.int32, count: wp.int32,
    ):  # fmt: skip
        """Places are computed in float64, and with EXACT_EXPONENT distances as well: sums of two numbers of float32
        take three times as many operations. An end point on a cell's edge may count to either side, since the
        interpolated distance is the same.
        """
        cells = block_cells()
        rest_x, rest_y = block_rests(), block_rests()
        exponent, exponent_low = block_numbers(), block_numbers()
        # Half a cell less, since interpolation is between centres, and half a cell more, so that rounding to
        # nearest gives the cell below.
        from_x = (double(pose.x) - DOUBLE_ONE) + double(low.x)
        from_y = (double(pose.y) - DOUBLE_ONE) + double(low.y)
        cos = double(pose.z) + double(low.z)
        sin = double(pose.w) + double(low.w)
        i = int(0)
        while i < count:
            to, to_low = point_at(point, begin + i), point_at(point_low, begin + i)
            to_x = double(to.x) + double(to_low.x)
            to_y = double(to.y) + double(to_low.y)
            x = multiplied_lanes(cos, to_x, multiplied_lanes(-sin, to_y, from_x))
            y = multiplied_lanes(sin, to_x, multiplied_lanes(cos, to_y, from_y))
            col = x + INTEGERS
            row = y + INTEGERS
            rest_x[i] = rest((x - (col - INTEGERS)) + DOUBLE_HALF)
            rest_y[i] = rest((y - (row - INTEGERS)) + DOUBLE_HALF)
            below = wp.vec2i(wp.int32(wp.cast(col, wp.int64)), wp.int32(wp.cast(row, wp.int64)))
            cells[i] = table_place(origin.x + below.x, origin.y + below.y, window)
            i += 1
        a, b, c, d = block_distances(cells, table, window)
        factor = rest(term_of.square_scale(terms))
        if EXACT_EXPONENT:
            factor += rest(term_of.square_scale_low(terms))
        i = int(0)
        while i < BLOCK_TERMS:
            square = square_lanes(vec4(a[i], b[i], c[i], d[i]), rest_x[i], rest_y[i], factor)
            parts_of = shape_exponent(square, term_of.shape_power(terms), term_of.shape_rate(terms))
            exponent[i] = parts_of.x
            exponent_low[i] = parts_of.y
            i += 1
        return exponent, exponent_low


@wp.func
def log_of_exponent_lanes(exponent: real, exponent_low: real, terms: wp.array(dtype=FieldTerms)):
    """Return log p of the exponent of the density of a hit in two parts."""
    if LINEAR:
        p = term_of.rand_density(terms)
        if HIT:
            hit = term_of.hit_peak(terms) * exp_lanes(-exponent)
            if EXACT_EXPONENT:
                # The second part is arbitrary where the density underflows.
                hit = wp.where(hit > ZERO, hit * (ONE - exponent_low), hit)
            p += hit
        return log_lanes(p)
    else:
        log_hit = (term_of.hit_peak(terms) - exponent) + (term_of.hit_peak_low(terms) - exponent_low)
        if RAND:
            # The larger of two exponentials is 1.
            random = term_of.rand_density(terms)
            return wp.max(log_hit, random) + log_lanes(ONE + exp_lanes(-wp.abs(log_hit - random)))
        else:
            return log_hit


@wp.func
def block_logs(exponent: block_numbers, exponent_low: block_numbers, terms: wp.array(dtype=FieldTerms)):
    """Return log p of the exponents of a block."""
    values = block_numbers()
    i = int(0)
    while i < BLOCK_TERMS:
        values[i] = log_of_exponent_lanes(exponent[i], exponent_low[i], terms)
        i += 1
    return values
