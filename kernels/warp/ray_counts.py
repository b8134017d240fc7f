"""Counts of hits and misses of cells, of which the log-odds of an occupancy grid are sums (book section 9.2).

Start and end of a ray are integers in units of 1/4096 cell, and the walk from cell to cell compares products of
integers, so that all backends visit the same cells. A ray misses each cell that it leaves. Its last cell is hit where
the ray ends at an obstacle, and missed otherwise. A tie, the ray through a corner, steps in x first.
"""

import warp as wp

from .prelude import kernel

# Fraction bits of a coordinate.
BITS = wp.constant(12)
UNIT = wp.constant(1 << 12)


# Return the distance along an axis to the first boundary that a ray crosses.
@wp.func
def to_boundary(position: wp.int32, step: wp.int32):
    inside = position & (UNIT - 1)
    return wp.where(step > 0, UNIT - inside, inside)


# Add the cells of rays to the counts; cells outside the grid are left out. One work-item takes a ray.
@kernel
def count_rays(
    start: wp.array(dtype=wp.vec2i),
    end: wp.array(dtype=wp.vec2i),
    hit: wp.array(dtype=wp.int32),
    hits: wp.array(dtype=wp.int32),
    misses: wp.array(dtype=wp.int32),
    rows: wp.int32,
    cols: wp.int32,
    rays: wp.int32,
):
    n = wp.tid()
    if n >= rays:
        return
    begin = start[n]
    last = end[n]
    col = begin.x >> BITS
    row = begin.y >> BITS
    step_x = wp.where(last.x >= begin.x, 1, -1)
    step_y = wp.where(last.y >= begin.y, 1, -1)
    size_x = wp.int64(step_x) * (wp.int64(last.x) - wp.int64(begin.x))
    size_y = wp.int64(step_y) * (wp.int64(last.y) - wp.int64(begin.y))
    left_x = step_x * ((last.x >> BITS) - col)
    left_y = step_y * ((last.y >> BITS) - row)
    # Negative where the next boundary is one in x.
    lead = wp.int64(to_boundary(begin.x, step_x)) * size_y - wp.int64(to_boundary(begin.y, step_y)) * size_x
    while left_x + left_y > 0:
        if col >= 0 and col < cols and row >= 0 and row < rows:
            wp.atomic_add(misses, row * cols + col, 1)
        if left_x > 0 and (left_y == 0 or lead <= wp.int64(0)):
            col += step_x
            left_x -= 1
            lead += wp.int64(UNIT) * size_y
        else:
            row += step_y
            left_y -= 1
            lead -= wp.int64(UNIT) * size_x
    if col >= 0 and col < cols and row >= 0 and row < rows:
        if hit[n] != 0:
            wp.atomic_add(hits, row * cols + col, 1)
        else:
            wp.atomic_add(misses, row * cols + col, 1)


def make(name, flags):
    """Return the kernel of the file; no flag changes it."""
    return {"count_rays": count_rays}[name]
