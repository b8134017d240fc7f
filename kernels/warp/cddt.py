"""Expected range by a compressed directional distance transform (Walsh and Karaman 2018)."""

import warp as wp

from .flags import OUTSIDE_OCCUPIED
from .ray import angle_bin, off_grid, ray_direction
from .types import Caster, Window, real, vec2, vec4

ENTRY = wp.int32
ZERO = real(0.0)
ENTRY_UNIT = real(1024.0)
COSINE_UNIT = real(2.0**-30)
# Coordinates are clamped to this many cells: no map has as many, and indices still fit.
FARTHEST, NOWHERE = real(1048576.0), real(-1048576.0)


@wp.func
def cast_ray(
    map_table: wp.array(dtype=ENTRY), window: Window, cell: wp.vec2i, pose: vec4, ray: vec2, limit: real,
    caster: Caster,
):  # fmt: skip
    """Return the distance in cells to the first obstacle of the line, limit where none is nearer."""
    lines = map_table[0]
    first = 1 + 3 * caster.bins
    if off_grid(cell.x, cell.y, window.rows, window.cols):
        if OUTSIDE_OCCUPIED:
            return ZERO
    else:
        index = cell.y * window.cols + cell.x
        bits = wp.uint32(map_table[first + caster.bins * lines + 1 + index / 32])
        if (bits >> wp.uint32(index % 32)) & wp.uint32(1) != wp.uint32(0):
            return ZERO
    bin = angle_bin(ray_direction(pose, ray), caster.bins)
    c = real(map_table[1 + 3 * bin]) * COSINE_UNIT
    s = real(map_table[2 + 3 * bin]) * COSINE_UNIT
    x = real(cell.x) + pose.x
    y = real(cell.y) + pose.y
    along = c * x + s * y
    across = c * y - s * x
    if wp.abs(across) > FARTHEST:
        return limit
    line = int(wp.floor(across)) - map_table[3 + 3 * bin]
    if line < 0 or line >= lines:
        return limit
    start = int(wp.clamp(along, NOWHERE, FARTHEST) * ENTRY_UNIT)
    low = int(map_table[first + bin * lines + line])
    high = int(map_table[first + bin * lines + line + 1])
    end = high
    while low < high:
        middle = low + (high - low) / 2
        if map_table[middle] < start:
            low = middle + 1
        else:
            high = middle
    if low == end:
        return limit
    t = real(map_table[low]) / ENTRY_UNIT - along
    return wp.max(wp.min(t, limit), ZERO)
