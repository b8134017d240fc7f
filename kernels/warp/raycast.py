"""Expected range z*: distance from a beam's origin to the first occupied cell, exactly (book section 6.3).

An Amanatides-Woo walk that crosses a whole empty rectangle at a time and visits the same cells; ties (corners) step in
x first.
"""

import functools
from types import SimpleNamespace

import warp as wp

from . import ray as ray_file
from . import rectangles as rectangles_file
from .prelude import precision

ENTRY = wp.uint16


@functools.cache
def functions(flags):
    """cast_ray specialised by the flags."""
    types = precision(flags)
    real, vec2, vec4 = types.real, types.vec2, types.vec4
    geometry = ray_file.functions(flags)
    make_ray, start_walk, off_grid = geometry.make_ray, geometry.start_walk, geometry.off_grid
    crossed = geometry.crossed
    padded = rectangles_file.functions(flags).padded
    ORIGINS_OUTSIDE = "ORIGINS_OUTSIDE" in flags
    OUTSIDE_OCCUPIED = "OUTSIDE_OCCUPIED" in flags
    SECTORS_2 = "SECTORS_2" in flags
    SECTORS_4 = "SECTORS_4" in flags
    SECTORS = 4 if SECTORS_4 else 2 if SECTORS_2 else 1
    ZERO, ONE = real(0.0), real(1.0)
    FLATTEST, STEEPEST = real(0.41421356), real(2.4142136)

    # Sector of a quadrant's directions, from flat to steep. Any would do; the right one has the longest steps.
    @wp.func
    def sector_of(speed_x: real, speed_y: real):
        sector = int(0)
        if SECTORS_2:
            sector = wp.where(speed_y > speed_x, 1, 0)
        if SECTORS_4:
            steep = speed_y > speed_x
            sector = wp.where(steep, 2, 0)
            sector += wp.where(speed_y > wp.where(steep, STEEPEST, FLATTEST) * speed_x, 1, 0)
        return sector

    # Distance in cells to the first occupied cell, or limit where there is none nearer.
    @wp.func
    def cast_ray(
        map_table: wp.array(dtype=ENTRY),
        rows: wp.int32,
        cols: wp.int32,
        cell: wp.vec2i,
        pose: vec4,
        ray: vec2,
        limit: real,
        bins: wp.int32,
        slack: real,
        tolerance: real,
    ):
        r = make_ray(pose, ray)
        if ORIGINS_OUTSIDE and OUTSIDE_OCCUPIED:
            if off_grid(cell.x, cell.y, rows, cols):
                return ZERO
        start = start_walk(r, cell, rows, cols, limit)
        k_x = real(start.k_x)
        k_y = real(start.k_y)
        t = real(start.t)
        if t >= limit:
            return limit
        plane = (wp.where(r.right, 0, 1) + wp.where(r.up, 0, 2)) * SECTORS + sector_of(r.speed_x, r.speed_y)
        origin = plane * (rows + 2) * (cols + 2) + padded(cell.y, cell.x, cols)
        step_y = r.step_y * (cols + 2)
        while True:
            sides = int(map_table[origin + r.step_x * int(k_x) + step_y * int(k_y)])
            if sides == 0:
                if OUTSIDE_OCCUPIED:
                    return t
                else:
                    col = cell.x + r.step_x * int(k_x)
                    row = cell.y + r.step_y * int(k_y)
                    return wp.where(off_grid(col, row, rows, cols), limit, t)
            far_x = k_x + real((sides & 255) - 1)
            far_y = k_y + real((sides >> 8) - 1)
            t_x = (far_x + r.a_x) * r.inv_x
            t_y = (far_y + r.a_y) * r.inv_y
            by_x = t_x <= t_y
            t = wp.where(by_x, t_x, t_y)
            if t >= limit:
                return limit
            speed = wp.where(by_x, r.speed_y, r.speed_x)
            a = wp.where(by_x, r.a_y, r.a_x)
            aside = crossed(t, speed, a, wp.where(by_x, r.inv_y, r.inv_x), not by_x)
            k_x = wp.where(by_x, far_x + ONE, aside)
            k_y = wp.where(by_x, aside, far_y + ONE)

    return SimpleNamespace(cast_ray=cast_ray)
