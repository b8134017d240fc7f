"""Expected range by marching through the distance field (sphere tracing): at each place the ray steps by the distance
from the cell's centre to the nearest obstacle's centre, less slack, and by tolerance at least.

With slack sqrt(2) no step passes an obstacle but the least one, so a range is too long by at most tolerance, and an
obstacle is missed only where the ray's way through it is shorter than that. With slack 0 (what other programs do) a
step may pass obstacles.
"""

import functools
from types import SimpleNamespace

import warp as wp

from . import ray as ray_file
from .prelude import precision

ENTRY = wp.float32


@functools.cache
def functions(flags):
    """cast_ray specialised by the flags."""
    types = precision(flags)
    real, vec2, vec4 = types.real, types.vec2, types.vec4
    geometry = ray_file.functions(flags)
    make_ray, start_walk, off_grid = geometry.make_ray, geometry.start_walk, geometry.off_grid
    ORIGINS_OUTSIDE = "ORIGINS_OUTSIDE" in flags
    OUTSIDE_OCCUPIED = "OUTSIDE_OCCUPIED" in flags
    ZERO = real(0.0)
    # A step that is told from none at any distance, as a part of it.
    LEAST_STEP = real(2.0**-22)

    # Distance in cells to a place in an occupied cell, or limit where none is found nearer.
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
        t = real(0.0)
        if ORIGINS_OUTSIDE:
            if off_grid(cell.x, cell.y, rows, cols):
                if OUTSIDE_OCCUPIED:
                    return ZERO
                else:
                    start = start_walk(r, cell, rows, cols, limit)
                    t = start.t
                    t += tolerance + t * LEAST_STEP
        while t < limit:
            col = cell.x + int(wp.floor(pose.x + t * r.direction.x))
            row = cell.y + int(wp.floor(pose.y + t * r.direction.y))
            if off_grid(col, row, rows, cols):
                if OUTSIDE_OCCUPIED:
                    return t
                else:
                    return limit
            distance = real(map_table[row * cols + col])
            if distance == ZERO:
                return t
            t += wp.max(distance - slack, tolerance + t * LEAST_STEP)
        return limit

    return SimpleNamespace(cast_ray=cast_ray)
