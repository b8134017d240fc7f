"""Expected range by the plain walk of Amanatides and Woo (1987), cell by cell."""

import warp as wp

from .flags import ORIGINS_OUTSIDE, OUTSIDE_OCCUPIED
from .ray import make_ray, off_grid, start_walk
from .rectangles import padded
from .types import Caster, Window, real, vec2, vec4

ENTRY = wp.uint8
ZERO = real(0.0)


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
    k_x = int(start.k_x)
    k_y = int(start.k_y)
    t = real(start.t)
    if t >= limit:
        return limit
    while True:
        state = int(map_table[padded(cell.y + r.step_y * k_y, cell.x + r.step_x * k_x, window.cols)])
        if state != 0:
            if OUTSIDE_OCCUPIED:
                return t
            else:
                return wp.where(state == 1, t, limit)
        t_x = (real(k_x) + r.a_x) * r.inv_x
        t_y = (real(k_y) + r.a_y) * r.inv_y
        t = wp.min(t_x, t_y)
        if t >= limit:
            return limit
        if t_x <= t_y:
            k_x += 1
        else:
            k_y += 1
