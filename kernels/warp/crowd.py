"""Moving shapes of worlds: their places in the cells of grids, directions from poses, and the nearest along rays."""

import math

import warp as wp

from .heading import cos_sin
from .placement import FRAME_NUMBERS, ZERO, frame_in, within_reach
from .prelude import kernel, reader, work_item
from .ray import ray_direction
from .shapes import (
    BOX,
    DIRECTIONS,
    DISC,
    QUARTER,
    box_numbers,
    covered_rays,
    directions_of,
    meet_shape,
    relative_shape,
    shape_at,
    sight_at,
)
from .types import Frame, real, vec2, vec4

# Largest number of a shape.
LARGEST_SHAPE = wp.constant(wp.float64(1e6))
# Distance from a world to which its segments and boxes reach [cells].
BEYOND = wp.constant(wp.float64(16384.0))
NUMBER_ZERO, NUMBER_ONE, NONE, TWO = real(0.0), real(1.0), real(math.nan), wp.float64(2.0)
cell_at, pose_at, ray_at, turn_at = reader(wp.vec2i), reader(vec4), reader(vec2), reader(wp.int32)


@kernel
def find_sights(shapes, world, pose_cell, pose, sights, particles, crowd):
    """Find the sights of particles. One work-item takes a particle and shape."""
    item = work_item(wp.tid())
    count = crowd.discs + crowd.boxes + crowd.segments
    n = item // count
    i = item % count
    if n >= particles:
        return
    place = cell_at(world, 2 * n + 1)
    if i == place.y:
        return
    at = place.x * crowd.stride + shape_at(crowd, i)
    one = relative_shape(shapes, at, i, crowd, cell_at(pose_cell, n), pose_at(pose, n))
    seen = directions_of(one, box_numbers(shapes, at, i, crowd), i, crowd, vec2(NUMBER_ONE, NUMBER_ZERO))
    for k in range(int(wp.floor(seen.x * QUARTER)), int(wp.floor(seen.y * QUARTER)) + 1):
        # Each bit is added to a word once.
        wp.atomic_add(sights, 2 * sight_at(crowd, n, k) + (i >> 5), int(wp.uint32(1) << wp.uint32(i & 31)))


@kernel
def meet_shapes(shapes, world, pose_cell, pose, ray, turns, ranges, particles, rays, limit, crowd):
    """Find the distances of the nearest shapes along the rays of particles, limit where none is nearer."""
    n = work_item(wp.tid())
    if n >= particles:
        return
    cell = cell_at(pose_cell, n)
    sensor = pose_at(pose, n)
    place = cell_at(world, 2 * n + 1)
    first = place.x * crowd.stride
    for k in range(rays):
        ranges[n * rays + k] = limit
    for i in range(crowd.discs + crowd.boxes + crowd.segments):
        at = first + shape_at(crowd, i)
        one = relative_shape(shapes, at, i, crowd, cell, sensor)
        box = box_numbers(shapes, at, i, crowd)
        covered = covered_rays(one, box, i, crowd, vec2(sensor.z, sensor.w), turns, rays)
        number = wp.where(i == place.y, 0, covered.y)
        for j in range(number):
            r = covered.x + j
            r = wp.where(r >= rays, r - rays, r)
            k = n * rays + turn_at(turns, DIRECTIONS + 1 + r)
            met = meet_shape(one, vec2(box.x, box.y), i, crowd, ray_direction(sensor, ray_at(ray, r)))
            if met.x < ranges[k]:
                ranges[k] = met.x


@wp.func
def point_in(x: wp.float64, y: wp.float64, here: Frame):
    """Return a point of the world in cells of a frame."""
    u = x - here.origin_x
    v = y - here.origin_y
    if here.yaw_sin != ZERO:
        before = u
        u = here.yaw_cos * u + here.yaw_sin * v
        v = here.yaw_cos * v - here.yaw_sin * before
    return wp.vec2d(within_reach(u / here.resolution), within_reach(v / here.resolution))


@wp.func
def part_near(low: wp.float64, high: wp.float64, at: wp.float64, reach: wp.float64):
    """Return the part of an interval within reach of a number, or the interval where that part is empty."""
    begin = wp.max(low, at - reach)
    end = wp.min(high, at + reach)
    return wp.where(begin < end, wp.vec2d(begin, end), wp.vec2d(low, high))


@kernel
def place_shapes(raw, frames, shapes, frame, count, numbers, begin, stride, worlds):
    """Place moving shapes of one kind."""
    w, i = wp.tid()
    if i >= count or w >= worlds:
        return
    at = (w * count + i) * numbers
    to = w * stride + begin + i * wp.where(numbers == 5, BOX, DISC)
    here = frame_in(frames, w, frame)
    none = bool(False)
    for k in range(numbers):
        if not (wp.abs(wp.float64(raw[at + k])) <= LARGEST_SHAPE):
            none = bool(True)
    length = wp.float64(raw[at + wp.where(numbers == 3, 2, 3)])
    if numbers != 4 and length < ZERO:
        none = bool(True)
    if numbers == 5:
        if wp.float64(raw[at + 4]) < ZERO:
            none = bool(True)
    if none:
        for k in range(wp.where(numbers == 5, BOX, DISC)):
            shapes[to + k] = NONE
        return
    centre = point_in(wp.float64(raw[at]), wp.float64(raw[at + 1]), here)
    reach = frames[w * FRAME_NUMBERS + 4] + frames[w * FRAME_NUMBERS + 5] + BEYOND
    if numbers == 3:
        shapes[to + 2] = real(length / here.resolution)
        shapes[to + 3] = NUMBER_ZERO
    elif numbers == 4:
        other = point_in(wp.float64(raw[at + 2]), length, here)
        x = other.x - centre.x
        y = other.y - centre.y
        whole = wp.sqrt(x * x + y * y)
        part = part_near(ZERO, whole, -(x * centre.x + y * centre.y) / whole, reach)
        if part.y < whole:
            other = wp.vec2d(centre.x + x * (part.y / whole), centre.y + y * (part.y / whole))
        if part.x > ZERO:
            centre = wp.vec2d(centre.x + x * (part.x / whole), centre.y + y * (part.x / whole))
        shapes[to + 2] = real(other.x)
        shapes[to + 3] = real(other.y)
    else:
        turned = cos_sin(wp.float64(raw[at + 2]))
        cosine = turned.x
        sine = turned.y
        if here.yaw_sin != ZERO:
            cosine = turned.x * here.yaw_cos + turned.y * here.yaw_sin
            sine = turned.y * here.yaw_cos - turned.x * here.yaw_sin
        u = length / here.resolution / TWO
        v = wp.float64(raw[at + 4]) / here.resolution / TWO
        along = part_near(-u, u, -(cosine * centre.x + sine * centre.y), reach)
        aside = part_near(-v, v, sine * centre.x - cosine * centre.y, reach)
        by_u = (along.x + along.y) / TWO
        by_v = (aside.x + aside.y) / TWO
        middle_x = centre.x + (cosine * by_u - sine * by_v)
        middle_y = centre.y + (sine * by_u + cosine * by_v)
        centre = wp.vec2d(middle_x, middle_y)
        half_length = (along.y - along.x) / TWO
        half_width = (aside.y - aside.x) / TWO
        shapes[to + 2] = real(cosine)
        shapes[to + 3] = real(sine)
        shapes[to + 4] = real(half_length)
        shapes[to + 5] = real(half_width)
        # The radius of a circle around the box, with a margin for rounding.
        around = wp.sqrt(half_length * half_length + half_width * half_width)
        shapes[to + 6] = real(around * wp.float64(1.00001) + wp.float64(0.001))
        shapes[to + 7] = NUMBER_ZERO
    shapes[to] = real(centre.x)
    shapes[to + 1] = real(centre.y)
