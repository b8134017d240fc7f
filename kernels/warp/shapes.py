"""Moving shapes of a world: discs, boxes and segments, in cells of its grid; shapes.cl has their layout."""

import math

import warp as wp

from .bits import lowest_bit
from .prelude import reader
from .ray import ray_direction
from .types import Crowd, Window, real, vec2, vec4

DISC, BOX, SEGMENT = wp.constant(4), wp.constant(8), wp.constant(4)
# Ranges of directions of a particle's sights, and of a table of beams.
SIGHTS, DIRECTIONS = wp.constant(64), wp.constant(4096)
cell_at = reader(wp.vec2i)


@wp.func
def world_window(world: wp.array(dtype=wp.vec2i), n: wp.int32):
    """Return the part of the grid that a particle's world fills."""
    size = cell_at(world, 2 * n).y
    window = Window()
    window.rows = size >> 16
    window.cols = size & 0xFFFF
    return window


@wp.func
def world_begin(world: wp.array(dtype=wp.vec2i), n: wp.int32, each: wp.int32):
    """Return the first entry of a particle's world in a table with ``each`` entries for a cell."""
    return wp.int64(cell_at(world, 2 * n).x) * wp.int64(each)


number_at, four_at = reader(real), reader(real, 4)
ZERO, ONE, TWO, MINUS_ONE = real(0.0), real(1.0), real(2.0), real(-1.0)
TINY, NEVER, ALWAYS, UNKNOWN = real(1e-30), real(math.inf), real(-math.inf), real(math.nan)
# Widening of a shape's range of directions, which covers rounding, in quarters of a turn.
APART = real(1.25e-4)
THREE, TURN, QUARTER, NEAR, OPPOSITE = real(3.0), real(4.0), real(SIGHTS / 4), real(0.98), real(-1e-3)
NEARLY_ALL = real(3.999)


@wp.func
def turned(x: real, y: real):
    """Return a direction as a number from 0 to 4, which grows with the angle, at a rate that varies."""
    part = y / (wp.abs(x) + wp.abs(y))
    return wp.where(x >= ZERO, ONE + part, THREE - part)


@wp.func
def seen_between(low: vec2, high: vec2, around: wp.bool):
    """Return the first and the last direction in which a shape is seen, from the directions of its ends."""
    if around:
        return vec2(ZERO, NEARLY_ALL)
    first = turned(low.x, low.y) - APART
    last = turned(high.x, high.y) + APART
    return vec2(first, wp.where(last < first, last + TURN, last))


@wp.func
def directions_of_disc(x: real, y: real, radius: real):
    """Return the directions in which a disc, or a circle around a shape, is seen; in all near its edge and inside."""
    square = x * x + y * y
    along = wp.sqrt(square - radius * radius)
    low = vec2(x * along + y * radius, y * along - x * radius)
    high = vec2(x * along - y * radius, y * along + x * radius)
    return seen_between(low, high, not (radius * radius < NEAR * square - TINY))


@wp.func
def directions_of_segment(x: real, y: real, end_x: real, end_y: real):
    """Return the directions in which a segment is seen."""
    turn = x * end_y - y * end_x
    along = x * end_x + y * end_y
    at_end = (x == ZERO and y == ZERO) or (end_x == ZERO and end_y == ZERO)
    between = wp.abs(turn) <= OPPOSITE * along or at_end
    one = vec2(x, y)
    other = vec2(end_x, end_y)
    if turn >= ZERO:
        return seen_between(one, other, between)
    return seen_between(other, one, between)


@wp.func
def shape_at(crowd: Crowd, i: wp.int32):
    """Return the index of a shape's first number."""
    boxes = wp.max(i - crowd.discs, 0)
    segments = wp.max(boxes - crowd.boxes, 0)
    return DISC * (i - boxes) + BOX * (boxes - segments) + SEGMENT * segments


@wp.func
def relative_shape(shapes: wp.array(dtype=real), one: wp.int32, i: wp.int32, crowd: Crowd, cell: wp.vec2i, pose: vec4):
    """Return a shape's numbers relative to a pose, from the first four in its world."""
    four = four_at(shapes, one)
    x = (four[0] - real(cell.x)) - pose.x
    y = (four[1] - real(cell.y)) - pose.y
    if i < crowd.discs + crowd.boxes:
        return vec4(x, y, four[2], four[3])
    return vec4(x, y, (four[2] - real(cell.x)) - pose.x, (four[3] - real(cell.y)) - pose.y)


@wp.func
def box_numbers(shapes: wp.array(dtype=real), one: wp.int32, i: wp.int32, crowd: Crowd):
    """Return the other numbers of a box, 0 of other shapes."""
    if i >= crowd.discs and i < crowd.discs + crowd.boxes:
        return four_at(shapes, one + 4)
    return vec4(ZERO, ZERO, ZERO, ZERO)


turn_at = reader(wp.int32)
EACH = real(DIRECTIONS / 4)


@wp.func
def directions_of(one: vec4, box: vec4, i: wp.int32, crowd: Crowd, heading: vec2):
    """Return the first and the last direction, relative to a heading, in which a shape is seen."""
    if not (one.x - one.x == ZERO):
        return vec2(ZERO, MINUS_ONE)
    along = heading.x * one.x + heading.y * one.y
    aside = heading.x * one.y - heading.y * one.x
    if i < crowd.discs + crowd.boxes:
        return directions_of_disc(along, aside, wp.where(i < crowd.discs, one.z, box.z))
    return directions_of_segment(
        along, aside, heading.x * one.z + heading.y * one.w, heading.x * one.w - heading.y * one.z
    )


@wp.func
def covered_rays(
    one: vec4, box: vec4, i: wp.int32, crowd: Crowd, heading: vec2, turns: wp.array(dtype=wp.int32), rays: wp.int32
):  # fmt: skip
    """Return the rays that a shape covers: the place of the first among the rays in order, and their number."""
    seen = directions_of(one, box, i, crowd, heading)
    low = int(wp.floor(seen.x * EACH))
    high = int(wp.floor(seen.y * EACH))
    since = low & (DIRECTIONS - 1)
    to = since + high - low
    begin = turn_at(turns, since)
    end = turn_at(turns, (to & (DIRECTIONS - 1)) + 1) + wp.where(to >= DIRECTIONS, rays, 0)
    return wp.vec2i(begin, wp.where(high < low, 0, end - begin))


@wp.func
def sight_at(crowd: Crowd, n: wp.int32, sight: wp.int32):
    """Return the index of the shapes that a particle may see in a range of directions."""
    return crowd.begin + (n * SIGHTS + (sight & (SIGHTS - 1))) * crowd.pairs


@wp.func
def meet_disc(dx: real, dy: real, x: real, y: real, radius: real):
    """Return the distance along a ray to a disc, infinite without one, and the cosine of incidence."""
    along = dx * x + dy * y
    aside = dx * y - dy * x
    square = (radius - aside) * (radius + aside)
    half_chord = wp.sqrt(wp.where(square > ZERO, square, ZERO))
    near = along - half_chord
    far = along + half_chord
    t = wp.where(near > ZERO, near, ZERO)
    cosine = wp.where(radius > ZERO, half_chord / wp.where(radius > ZERO, radius, ONE), ONE)
    return vec2(wp.where(square >= ZERO and far >= ZERO, t, NEVER), wp.where(near > ZERO, cosine, ONE))


@wp.func
def meet_box(
    dx: real, dy: real, x: real, y: real, cosine: real, sine: real, half_length: real, half_width: real
):  # fmt: skip
    """Return the same for a box with this cosine and sine of its yaw."""
    u = cosine * dx + sine * dy
    v = cosine * dy - sine * dx
    p = -(cosine * x + sine * y)
    q = -(cosine * y - sine * x)
    fast_u = wp.abs(u)
    fast_v = wp.abs(v)
    inv_u = ONE / wp.where(fast_u < TINY, TINY, fast_u)
    inv_v = ONE / wp.where(fast_v < TINY, TINY, fast_v)
    from_u = wp.where(u < ZERO, -p, p)
    from_v = wp.where(v < ZERO, -q, q)
    flat_u = wp.where(wp.abs(p) <= half_length, ALWAYS, NEVER)
    flat_v = wp.where(wp.abs(q) <= half_width, ALWAYS, NEVER)
    in_u = wp.where(fast_u < TINY, flat_u, (-half_length - from_u) * inv_u)
    in_v = wp.where(fast_v < TINY, flat_v, (-half_width - from_v) * inv_v)
    out_u = wp.where(fast_u < TINY, NEVER, (half_length - from_u) * inv_u)
    out_v = wp.where(fast_v < TINY, NEVER, (half_width - from_v) * inv_v)
    into = wp.where(in_u > in_v, in_u, in_v)
    out = wp.where(out_u < out_v, out_u, out_v)
    t = wp.where(into > ZERO, into, ZERO)
    straight = wp.where(in_u > in_v, fast_u, fast_v)
    return vec2(wp.where(into <= out and out >= ZERO, t, NEVER), wp.where(into > ZERO, straight, ONE))


@wp.func
def meet_segment(dx: real, dy: real, x: real, y: real, end_x: real, end_y: real):
    """Return the same of a segment; a ray along it meets its nearer end."""
    along = dx * x + dy * y
    end_along = dx * end_x + dy * end_y
    aside = dx * y - dy * x
    end_aside = dx * end_y - dy * end_x
    width = end_aside - aside
    length = end_along - along
    nearer = wp.where(along < end_along, along, end_along)
    farther = wp.where(along < end_along, end_along, along)
    across = along - aside / wp.where(width == ZERO, ONE, width) * length
    clipped = wp.where(across < nearer, nearer, wp.where(across > farther, farther, across))
    on_line = wp.where(nearer > ZERO, nearer, wp.where(farther < ZERO, MINUS_ONE, ZERO))
    t = wp.where(width == ZERO, wp.where(aside == ZERO, on_line, MINUS_ONE), clipped)
    straight = wp.abs(width) / wp.sqrt(wp.where(width == ZERO, ONE, width * width + length * length))
    meets = (aside <= ZERO and end_aside >= ZERO) or (aside >= ZERO and end_aside <= ZERO)
    return vec2(wp.where(meets and t >= ZERO, t, NEVER), straight)


@wp.func
def meet_shape(one: vec4, size: vec2, i: wp.int32, crowd: Crowd, direction: vec2):
    """Return the same of shape i of a world by its numbers relative to a pose; a box also has a size."""
    if i < crowd.discs:
        return meet_disc(direction.x, direction.y, one.x, one.y, one.z)
    if i < crowd.discs + crowd.boxes:
        return meet_box(direction.x, direction.y, one.x, one.y, one.z, one.w, size.x, size.y)
    return meet_segment(direction.x, direction.y, one.x, one.y, one.z, one.w)


@wp.func
def nearest_shape(
    shapes: wp.array(dtype=real), world: wp.array(dtype=wp.vec2i), crowd: Crowd, n: wp.int32, cell: wp.vec2i,
    pose: vec4, ray: vec2, t: real,
):  # fmt: skip
    """Return the distance to the nearest shape or obstacle along a ray, and the cosine of incidence."""
    direction = ray_direction(pose, ray)
    first = cell_at(world, 2 * n + 1).x * crowd.stride
    sights = sight_at(crowd, n, int(turned(direction.x, direction.y) * QUARTER))
    nearest = vec2(t, TWO)
    for k in range(2 * crowd.pairs):
        both = cell_at(world, sights + (k >> 1))
        left = wp.uint32(wp.where((k & 1) == 0, both.x, both.y))
        while left != wp.uint32(0):
            i = 32 * k + lowest_bit(left)
            left = left & (left - wp.uint32(1))
            one = first + shape_at(crowd, i)
            box = box_numbers(shapes, one, i, crowd)
            near = relative_shape(shapes, one, i, crowd, cell, pose)
            met = meet_shape(near, vec2(box.x, box.y), i, crowd, direction)
            if met.x < nearest.x:
                nearest = met
    return nearest


@wp.func
def shape_distance(
    shapes: wp.array(dtype=real), world: wp.array(dtype=wp.vec2i), crowd: Crowd, n: wp.int32, cell: wp.vec2i,
    point: vec2,
):  # fmt: skip
    """Return the distance from a point to the nearest shape that a particle sees."""
    nearest = real(NEVER)
    seen = cell_at(world, 2 * n + 1)
    one = seen.x * crowd.stride
    i = int(0)
    while i < crowd.discs + crowd.boxes + crowd.segments:
        x = (number_at(shapes, one) - real(cell.x)) - point.x
        y = (number_at(shapes, one + 1) - real(cell.y)) - point.y
        away = real(NEVER)
        if i < crowd.discs:
            away = wp.sqrt(x * x + y * y) - number_at(shapes, one + 2)
            one += DISC
        elif i < crowd.discs + crowd.boxes:
            u = wp.abs(number_at(shapes, one + 2) * x + number_at(shapes, one + 3) * y) - number_at(shapes, one + 4)
            v = wp.abs(number_at(shapes, one + 2) * y - number_at(shapes, one + 3) * x) - number_at(shapes, one + 5)
            out_u = wp.where(u > ZERO, u, ZERO)
            out_v = wp.where(v > ZERO, v, ZERO)
            # The comparisons turn NaN into 0.
            away = wp.where(x == x, wp.sqrt(out_u * out_u + out_v * out_v), UNKNOWN)
            one += BOX
        else:
            to_x = ((number_at(shapes, one + 2) - real(cell.x)) - point.x) - x
            to_y = ((number_at(shapes, one + 3) - real(cell.y)) - point.y) - y
            square = to_x * to_x + to_y * to_y
            part = -(x * to_x + y * to_y) / wp.where(square > ZERO, square, ONE)
            on = wp.where(part > ZERO, wp.where(part < ONE, part, ONE), ZERO)
            off_x = x + on * to_x
            off_y = y + on * to_y
            away = wp.sqrt(off_x * off_x + off_y * off_y)
            one += SEGMENT
        if i != seen.y and away < nearest:
            nearest = away
        i += 1
    nearest = wp.where(nearest > ZERO, nearest, ZERO)
    return nearest
