"""A ray on the grid and the walk along it, which all casters share."""

import warp as wp

from gpusense.interface.constants import TILE, TILE_PARTICLES, TILE_RAYS

from .flags import AMCL_LINES, FLOAT64, ORIGINS_OUTSIDE
from .types import RangeScale, Window, real, vec2, vec4

# Tiles of work-items for GPUs: a work-group takes a tile of neighbouring particles and rays with similar paths.


@wp.func
def off_grid(col: wp.int32, row: wp.int32, rows: wp.int32, cols: wp.int32):
    """Return whether a cell lies outside the grid."""
    return col < 0 or col >= cols or row < 0 or row >= rows


ZERO, ONE, MINUS_ONE = real(0.0), real(1.0), real(-1.0)
QUARTER, HALF = real(0.25), real(0.5)
# Abramowitz and Stegun 4.4.49 for the arc tangent, in turns.
C1, C3, C5, C7, C9 = (real(c) for c in (0.15913362, -0.05256880, 0.02867033, -0.01354934, 0.00331601))
# Smaller components of a direction count as 0, so that inverses are finite.
TINY = real(1e-30)
# Counts k of boundaries are floating-point numbers COUNT + k. From COUNT on all numbers are integers, so a sum with
# COUNT is rounded to nearest. The last bits of a count are k + FIRST, so a count is an index without a conversion.
COUNT = real(4503599627370496.0 if FLOAT64 else 8388608.0)
FIRST = wp.uint32(0 if FLOAT64 else 0x4B000000)
bits = wp.uint64 if FLOAT64 else wp.uint32


# A ray in the grid's frame: its unit direction; sign, absolute value and inverse of each component; and the
# distances in x and y to the first boundaries.
@wp.struct
class Ray:
    direction: vec2
    right: wp.bool
    up: wp.bool
    step_x: wp.int32
    step_y: wp.int32
    speed_x: real
    speed_y: real
    inv_x: real
    inv_y: real
    a_x: real
    a_y: real


# State of a walk: boundaries crossed in x and y, and the distance in cells.
@wp.struct
class Walk:
    k_x: wp.int32
    k_y: wp.int32
    t: real


@wp.func
def ray_direction(pose: vec4, ray: vec2):
    """Return the unit direction in the grid's frame."""
    dx = pose.z * ray.x - pose.w * ray.y
    dy = pose.w * ray.x + pose.z * ray.y
    return vec2(wp.where(wp.abs(dx) < TINY, ZERO, dx), wp.where(wp.abs(dy) < TINY, ZERO, dy))


@wp.func
def make_ray(pose: vec4, ray: vec2):
    """Return the ray of a pose and a beam."""
    r = Ray()
    r.direction = ray_direction(pose, ray)
    r.right = r.direction.x >= ZERO
    r.up = r.direction.y >= ZERO
    r.step_x = wp.where(r.right, 1, -1)
    r.step_y = wp.where(r.up, 1, -1)
    r.speed_x = wp.abs(r.direction.x)
    r.speed_y = wp.abs(r.direction.y)
    r.inv_x = ONE / r.speed_x
    r.inv_y = ONE / r.speed_y
    r.a_x = wp.where(r.right, ONE - pose.x, pose.x)
    r.a_y = wp.where(r.up, ONE - pose.y, pose.y)
    return r


@wp.func
def as_bits(count: real):
    """Return the last 32 bits of a count."""
    return wp.uint32(wp.cast(count, bits))


@wp.func
def farther(count: real, more: wp.uint32):
    """Add a number of boundaries to a count."""
    return wp.cast(wp.cast(count, bits) + bits(more), real)


@wp.func
def whole(count: real):
    """Return k of a count."""
    return wp.int32(as_bits(count) - FIRST)


@wp.func
def crossed(t: real, speed: real, a: real, inv: real, until: wp.bool):
    """Count the boundaries k = 0, 1, ... whose distance (k + a) * inv is below t, or with ``until`` at most t."""
    count = wp.max((t * speed - a) + COUNT, COUNT)
    here = ((count - COUNT) + a) * inv
    return wp.where(here < t or (until and here == t), count + ONE, count)


@wp.func
def start_walk(r: Ray, cell: wp.vec2i, window: Window, limit: real):
    """Return the walk at the ray's origin or, where that lies outside the grid, at the first cell inside."""
    walk = Walk()
    if ORIGINS_OUTSIDE:
        if off_grid(cell.x, cell.y, window.rows, window.cols):
            enter_x = wp.max(wp.where(r.right, -cell.x, cell.x - (window.cols - 1)), 0)
            enter_y = wp.max(wp.where(r.up, -cell.y, cell.y - (window.rows - 1)), 0)
            enter_t_x = wp.where(enter_x > 0, (real(enter_x - 1) + r.a_x) * r.inv_x, MINUS_ONE)
            enter_t_y = wp.where(enter_y > 0, (real(enter_y - 1) + r.a_y) * r.inv_y, MINUS_ONE)
            t = wp.max(enter_t_x, enter_t_y)
            walk.t = limit
            if t >= ZERO and t < limit:
                if enter_t_x > enter_t_y:
                    walk.k_x = enter_x
                    walk.k_y = whole(crossed(t, r.speed_y, r.a_y, r.inv_y, False))
                else:
                    walk.k_y = enter_y
                    walk.k_x = whole(crossed(t, r.speed_x, r.a_x, r.inv_x, True))
                if not off_grid(cell.x + r.step_x * walk.k_x, cell.y + r.step_y * walk.k_y, window.rows, window.cols):
                    walk.t = t
    return walk


@wp.func
def turn_of(direction: vec2):
    """Return a direction as a part of a full turn in [0, 1], within 2e-6."""
    x = wp.abs(direction.x)
    y = wp.abs(direction.y)
    a = wp.where(x > y, y / x, x / y)
    s = a * a
    tail = C5 + s * (C7 + s * C9)
    eighth = a * (C1 + s * (C3 + s * tail))
    quarter = wp.where(x > y, eighth, QUARTER - eighth)
    upper = wp.where(direction.x >= ZERO, quarter, HALF - quarter)
    return wp.where(direction.y >= ZERO, upper, ONE - upper)


@wp.func
def angle_bin(direction: vec2, bins: wp.int32):
    """Return the angle bin with the nearest centre; centres are at 0, 1 / bins, ... of a turn."""
    index = int(turn_of(direction) * real(bins) + HALF)
    return wp.where(index >= bins, index - bins, index)


@wp.func
def expected_range(t: real, scale: RangeScale):
    """Convert a distance in cells to metres, exactly range_max where nothing is nearer or met."""
    if AMCL_LINES:
        return wp.where(t == scale.limit, scale.range_max, t * scale.resolution)
    return wp.where(t >= scale.limit, scale.range_max, wp.min(t * scale.resolution, scale.range_max))


@wp.func
def tile_place(item: wp.int32, spread: wp.int32):
    """Return the place of a work-item's particle in the order."""
    return ((item // TILE) >> spread) * TILE_PARTICLES + item % TILE // TILE_RAYS


@wp.func
def tile_group(item: wp.int32, spread: wp.int32):
    """Return a work-item's group within its tile of particles."""
    return (item // TILE) & ((1 << spread) - 1)


@wp.func
def tile_ray(item: wp.int32, spread: wp.int32):
    """Return the first ray of a work-item."""
    return ((item // TILE) & ((1 << spread) - 1)) * TILE_RAYS + item % TILE_RAYS


@wp.func
def tile_step(spread: wp.int32):
    """Return the step from one ray of a work-item to its next."""
    return TILE_RAYS << spread
