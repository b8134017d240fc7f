"""Expected range by marching through the distance field (sphere tracing)."""

import warp as wp

from .flags import ORIGINS_OUTSIDE, OUTSIDE_OCCUPIED
from .ray import make_ray, off_grid, start_walk
from .types import Caster, Window, real, vec2, vec4

ENTRY = wp.float32
ZERO = real(0.0)
# Smallest step relative to the distance, so that every step changes the distance.
LEAST_STEP = real(2.0**-22)


@wp.func
def cast_ray(
    map_table: wp.array(dtype=ENTRY), window: Window, cell: wp.vec2i, pose: vec4, ray: vec2, limit: real,
    caster: Caster,
):  # fmt: skip
    """Return the distance in cells to a point in an occupied cell, limit where none is nearer."""
    r = make_ray(pose, ray)
    t = real(0.0)
    if ORIGINS_OUTSIDE:
        if off_grid(cell.x, cell.y, window.rows, window.cols):
            if OUTSIDE_OCCUPIED:
                return ZERO
            else:
                start = start_walk(r, cell, window, limit)
                t = start.t
                t += caster.tolerance + t * LEAST_STEP
    while t < limit:
        col = cell.x + int(wp.floor(pose.x + t * r.direction.x))
        row = cell.y + int(wp.floor(pose.y + t * r.direction.y))
        if off_grid(col, row, window.rows, window.cols):
            if OUTSIDE_OCCUPIED:
                return t
            else:
                return limit
        distance = real(map_table[row * window.cols + col])
        if distance == ZERO:
            return t
        t += wp.max(distance - caster.slack, caster.tolerance + t * LEAST_STEP)
    return limit
