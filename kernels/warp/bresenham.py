"""Expected range by Bresenham's line (1965) from the origin's cell to the cell at the ray's end."""

import warp as wp

from .flags import AMCL_LINES, BELUGA_LINES, ORIGINS_OUTSIDE, OUTSIDE_OCCUPIED
from .ray import make_ray, off_grid, start_walk
from .rectangles import padded
from .types import Caster, Window, real, vec2, vec4

ENTRY = wp.uint8
# The entry of the ring where a line meets nothing outside the grid; cells at which lines end have 0.
EDGE = 255
ZERO = real(0.0)


@wp.func
def cast_ray(
    map_table: wp.array(dtype=ENTRY), window: Window, cell: wp.vec2i, pose: vec4, ray: vec2, limit: real,
    caster: Caster,
):  # fmt: skip
    """Return the distance in cells from the origin's cell to the first occupied cell of the line, limit without one."""
    r = make_ray(pose, ray)
    if ORIGINS_OUTSIDE and OUTSIDE_OCCUPIED:
        if off_grid(cell.x, cell.y, window.rows, window.cols):
            return ZERO
    if ORIGINS_OUTSIDE and BELUGA_LINES:
        if off_grid(cell.x, cell.y, window.rows, window.cols):
            return limit
    start = start_walk(r, cell, window, limit)
    if start.t >= limit:
        return limit
    col = cell.x + r.step_x * start.k_x
    row = cell.y + r.step_y * start.k_y
    end_col = cell.x + int(wp.floor(pose.x + limit * r.direction.x))
    end_row = cell.y + int(wp.floor(pose.y + limit * r.direction.y))
    far_x = wp.abs(end_col - col)
    far_y = wp.abs(end_row - row)
    far = wp.max(far_x, far_y)
    # A line of a single cell goes on diagonally.
    longer = wp.max(far, 1)
    shorter = wp.where(far == 0, 1, wp.min(far_x, far_y))
    right = wp.where(end_col > col, 1, -1)
    up = wp.where(end_row > row, 1, -1)
    last = far
    if AMCL_LINES:
        last = far + 1
    along = int(0)
    aside = int(0)
    x = int(0)
    y = int(0)
    steps = int(map_table[padded(row, col, window.cols)])
    rest = int(longer)
    if BELUGA_LINES:
        rest = longer - 1
    # A leap beyond the line's end still ends in the table. Ranges are at most 2^20 cells, so sums stay below 2^31.
    while steps != 0 and steps != EDGE and along <= last:
        along += steps
        rest += 2 * shorter * steps
        aside += rest / (2 * longer)
        rest = rest % (2 * longer)
        x = wp.where(far_x >= far_y, along, aside)
        y = wp.where(far_x >= far_y, aside, along)
        steps = int(map_table[padded(row + up * y, col + right * x, window.cols)])
    if steps != 0 or along > last:
        return limit
    return start.t + wp.sqrt(real(x) * real(x) + real(y) * real(y))
