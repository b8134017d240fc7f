"""Expected range z*: the exact distance from a beam's origin to the first occupied cell (book section 6.3)."""

import warp as wp

from .flags import ORIGINS_OUTSIDE, OUTSIDE_OCCUPIED, ROW_GROUPS, SECTORS_2, SECTORS_4
from .prelude import reader
from .ray import COUNT, FIRST, Ray, as_bits, crossed, farther, make_ray, off_grid, start_walk
from .rectangles import OCCUPIED as OCCUPIED_ENTRY
from .types import Caster, Window, real, vec2, vec4

ENTRY = wp.uint16
entry_at = reader(ENTRY)
OCCUPIED = wp.uint32(OCCUPIED_ENTRY)
SECTORS = 4 if SECTORS_4 else 2 if SECTORS_2 else 1
ZERO, ABOVE_COUNT = real(0.0), real(float(COUNT) + 1.0)
FLATTEST, STEEPEST = real(0.41421356), real(2.4142136)
# Planes of a map.
PLANES = 4 * SECTORS


@wp.func
def sector_of(speed_x: real, speed_y: real):
    """Return the sector of a direction within its quadrant, from flat to steep."""
    sector = int(0)
    if SECTORS_2:
        sector = wp.where(speed_y > speed_x, 1, 0)
    if SECTORS_4:
        steep = speed_y > speed_x
        sector = wp.where(steep, 2, 0)
        sector += wp.where(speed_y > wp.where(steep, STEEPEST, FLATTEST) * speed_x, 1, 0)
    return sector


# Rows of a group of the planes; without ROW_GROUPS a group is a single row.
GROUP = 8 if ROW_GROUPS else 1
ROWS = wp.uint32(GROUP)


# The track of a ray through a plane: index of the origin's column, the origin's row, and steps in x and
# y, so that boundaries COUNT + k need no conversion; skip is what a group has beyond its first column.
@wp.struct
class Track:
    col: wp.uint32
    row: wp.uint32
    step_x: wp.uint32
    step_y: wp.uint32
    skip: wp.uint32


@wp.func
def track_of(r: Ray, cell: wp.vec2i, window: Window):
    """Return the track of a ray that begins in a cell through the plane of its direction."""
    plane = (wp.where(r.right, 0, 1) + wp.where(r.up, 0, 2)) * SECTORS + sector_of(r.speed_x, r.speed_y)
    stride = GROUP * (window.cols + 2)
    groups = (window.rows + 2 + GROUP - 1) // GROUP
    track = Track()
    track.step_x = wp.uint32(GROUP * r.step_x)
    track.col = wp.uint32(plane * groups * stride + GROUP * (cell.x + 1)) - track.step_x * FIRST
    track.skip = wp.uint32(stride - GROUP)
    if ROW_GROUPS:
        track.step_y = wp.uint32(r.step_y)
        track.row = wp.uint32(cell.y + 1) - track.step_y * FIRST
    else:
        track.step_y = wp.uint32(stride * r.step_y)
        track.col += wp.uint32(stride * (cell.y + 1)) - track.step_y * FIRST
    return track


@wp.func
def rectangle_at(map_table: wp.array(dtype=ENTRY), track: Track, k_x: real, k_y: real):
    """Return the rectangle at the cell of a track behind k_x and k_y boundaries."""
    col = track.col + track.step_x * as_bits(k_x)
    index = col + track.step_y * as_bits(k_y)
    if ROW_GROUPS:
        row = track.row + track.step_y * as_bits(k_y)
        index = col + row + row // ROWS * track.skip
    return wp.uint32(entry_at(map_table, wp.int32(index)))


@wp.func
def cast_ray(
    map_table: wp.array(dtype=ENTRY), window: Window, cell: wp.vec2i, pose: vec4, ray: vec2, limit: real,
    caster: Caster,
):  # fmt: skip
    """Return the distance in cells to the first occupied cell, limit where none is nearer."""
    r = make_ray(pose, ray)
    if ORIGINS_OUTSIDE and OUTSIDE_OCCUPIED:
        if off_grid(cell.x, cell.y, window.rows, window.cols):
            return ZERO
    start = start_walk(r, cell, window, limit)
    if ORIGINS_OUTSIDE:
        if start.t >= limit:
            return limit
    track = track_of(r, cell, window)
    k_x = COUNT + real(start.k_x)
    k_y = COUNT + real(start.k_y)
    t = real(start.t)
    sides = rectangle_at(map_table, track, k_x, k_y)
    # A step beyond limit still ends in the table. GPUs are fastest with a single exit of the loop.
    while sides > OCCUPIED and t < limit:
        end_x = farther(k_x, sides & wp.uint32(255))
        end_y = farther(k_y, sides >> wp.uint32(8))
        t_x = ((end_x - ABOVE_COUNT) + r.a_x) * r.inv_x
        t_y = ((end_y - ABOVE_COUNT) + r.a_y) * r.inv_y
        by_x = t_x <= t_y
        t = wp.where(by_x, t_x, t_y)
        speed = wp.where(by_x, r.speed_y, r.speed_x)
        a = wp.where(by_x, r.a_y, r.a_x)
        aside = crossed(t, speed, a, wp.where(by_x, r.inv_y, r.inv_x), not by_x)
        k_x = wp.where(by_x, end_x, aside)
        k_y = wp.where(by_x, aside, end_y)
        sides = rectangle_at(map_table, track, k_x, k_y)
    if OUTSIDE_OCCUPIED:
        return wp.min(t, limit)
    else:
        return wp.where(t < limit and sides == OCCUPIED, t, limit)
