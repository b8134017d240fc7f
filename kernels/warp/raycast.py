"""Expected range z*: distance from a beam's origin to the first occupied cell, exactly (book section 6.3).

An Amanatides-Woo walk that crosses a whole empty square at a time and visits the same cells; ties (corners) step in x
first.
"""

import functools
from types import SimpleNamespace

import warp as wp

from . import ray as ray_file
from . import squares as squares_file
from .prelude import precision

ENTRY = wp.uint8


@functools.cache
def functions(flags):
    """cast_ray specialised by the flags."""
    types = precision(flags)
    real, vec2, vec4 = types.real, types.vec2, types.vec4
    geometry = ray_file.functions(flags)
    make_ray, start_walk, off_grid = geometry.make_ray, geometry.start_walk, geometry.off_grid
    crossed_before, crossed_until = geometry.crossed_before, geometry.crossed_until
    padded = squares_file.functions(flags).padded
    ORIGINS_OUTSIDE = "ORIGINS_OUTSIDE" in flags
    OUTSIDE_OCCUPIED = "OUTSIDE_OCCUPIED" in flags
    ZERO = real(0.0)

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
        k_x = int(start.k_x)
        k_y = int(start.k_y)
        t = real(start.t)
        if t >= limit:
            return limit
        plane = (wp.where(r.right, 0, 1) + wp.where(r.up, 0, 2)) * (rows + 2) * (cols + 2)
        while True:
            col = cell.x + r.step_x * k_x
            row = cell.y + r.step_y * k_y
            side = int(map_table[plane + padded(row, col, cols)])
            if side == 0:
                if OUTSIDE_OCCUPIED:
                    return t
                else:
                    return wp.where(off_grid(col, row, rows, cols), limit, t)
            t_x = (real(k_x + side - 1) + r.a_x) * r.inv_x
            t_y = (real(k_y + side - 1) + r.a_y) * r.inv_y
            t = wp.min(t_x, t_y)
            if t >= limit:
                return limit
            if t_x <= t_y:
                k_x += side
                k_y = crossed_before(t, r.speed_y, r.a_y, r.inv_y)
            else:
                k_y += side
                k_x = crossed_until(t, r.speed_x, r.a_x, r.inv_x)

    return SimpleNamespace(cast_ray=cast_ray)
