"""The look-up table of expected ranges, filled by the exact caster from the centres of cells, some rows at a time."""

import warp as wp

from .prelude import kernel
from .raycast import cast_ray
from .types import Caster, real, vec2, vec4

ZERO, HALF, ONE = real(0.0), real(0.5), real(1.0)
PARTS = real(65535.0)


@kernel
def fill_lookup(rectangles, ray, lookup, window, bins, first_row, count, limit):
    """Fill rows of the table: one work-item takes a bin and cell. The table has fewer than 2^31 entries."""
    index, bin = wp.tid()
    if bin >= bins or index >= count * window.cols:
        return
    row = first_row + index / window.cols
    col = index % window.cols
    pose = vec4(HALF, HALF, ray[bin].x, ray[bin].y)
    t = cast_ray(rectangles, window, wp.vec2i(col, row), pose, vec2(ONE, ZERO), limit, Caster())
    part = int(t * (PARTS / limit) + HALF)
    lookup[(row * window.cols + col) * bins + bin] = wp.uint16(wp.where(t >= limit, 65535, wp.min(part, 65534)))
