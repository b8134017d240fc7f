"""Expected range by a look-up table over cells and angle bins (precomputed ranges, book section 6.3)."""

import warp as wp

from .flags import ORIGINS_OUTSIDE, OUTSIDE_OCCUPIED
from .ray import angle_bin, make_ray, off_grid, start_walk
from .types import Caster, Window, real, vec2, vec4

ENTRY = wp.uint16
ZERO = real(0.0)
PARTS = real(65535.0)


@wp.func
def cast_ray(
    map_table: wp.array(dtype=ENTRY), window: Window, cell: wp.vec2i, pose: vec4, ray: vec2, limit: real,
    caster: Caster,
):  # fmt: skip
    """Return the distance in cells from the table, limit where no obstacle is nearer."""
    col = int(cell.x)
    row = int(cell.y)
    r = make_ray(pose, ray)
    t = real(0.0)
    if ORIGINS_OUTSIDE:
        if off_grid(cell.x, cell.y, window.rows, window.cols):
            if OUTSIDE_OCCUPIED:
                return ZERO
            else:
                start = start_walk(r, cell, window, limit)
                if start.t >= limit:
                    return limit
                t = start.t
                col += r.step_x * start.k_x
                row += r.step_y * start.k_y
    part = int(map_table[(row * window.cols + col) * caster.bins + angle_bin(r.direction, caster.bins)])
    if part == 65535:
        return limit
    t += real(part) * (limit / PARTS)
    return wp.min(t, limit)
