"""Counts of hits and misses of cells, of which the log-odds of an occupancy grid are sums (book section 9.2)."""

import warp as wp

from gpusense.interface.constants import RAY_BITS

from .prelude import kernel

UNIT = 1 << RAY_BITS


@wp.func
def to_boundary(inside: wp.int32, step: wp.int32):
    """Return the distance along an axis to the first boundary that a ray crosses."""
    return wp.where(step > 0, UNIT - inside, inside)


@wp.func
def has_left(cell: wp.int32, step: wp.int32, cells: wp.int32):
    """Return whether a walk has left the extent of an axis for good."""
    return wp.where(step > 0, cell >= cells, cell < 0)


@wp.func
def crossed_before(first: wp.int32, size: wp.int64, reached: wp.int64, other: wp.int64, ties: wp.int32):
    """Return the number of boundaries of an axis that a ray crosses before a boundary of the other axis."""
    room = reached * size - wp.int64(first) * other - wp.int64(1 - ties)
    crossed = wp.int64(0)
    if room >= wp.int64(0):
        crossed = room / (wp.int64(UNIT) * other) + wp.int64(1)
    return crossed


@kernel
def count_rays(start_cell, start_inside, end_cell, end_inside, hit, hits, misses, rows, cols, rays):
    """Add the cells of rays to the counts; cells outside the grid are left out. One work-item takes a ray."""
    n = wp.tid()
    if n >= rays:
        return
    begin = start_inside[n]
    across = end_cell[n] - start_cell[n]
    last = end_inside[n] - begin
    col = start_cell[n].x
    row = start_cell[n].y
    span_x = wp.int64(across.x) * wp.int64(UNIT) + wp.int64(last.x)
    span_y = wp.int64(across.y) * wp.int64(UNIT) + wp.int64(last.y)
    step_x = wp.where(span_x >= wp.int64(0), 1, -1)
    step_y = wp.where(span_y >= wp.int64(0), 1, -1)
    size_x = wp.int64(step_x) * span_x
    size_y = wp.int64(step_y) * span_y
    left_x = step_x * across.x
    left_y = step_y * across.y
    first_x = to_boundary(begin.x, step_x)
    first_y = to_boundary(begin.y, step_y)
    # Skip the steps that bring the walk to the grid's columns and rows.
    need_x = wp.max(wp.where(step_x > 0, -col, col - (cols - 1)), 0)
    need_y = wp.max(wp.where(step_y > 0, -row, row - (rows - 1)), 0)
    if need_x > left_x or need_y > left_y:
        return
    done_x = wp.int64(need_x)
    done_y = wp.int64(0)
    if need_x > 0:
        reached = wp.int64(first_x) + (done_x - wp.int64(1)) * wp.int64(UNIT)
        done_y = wp.min(crossed_before(first_y, size_y, reached, size_x, 0), wp.int64(left_y))
    if done_y < wp.int64(need_y):
        done_y = wp.int64(need_y)
        reached = wp.int64(first_y) + (done_y - wp.int64(1)) * wp.int64(UNIT)
        done_x = wp.min(crossed_before(first_x, size_x, reached, size_y, 1), wp.int64(left_x))
    col += step_x * wp.int32(done_x)
    row += step_y * wp.int32(done_y)
    left_x -= wp.int32(done_x)
    left_y -= wp.int32(done_y)
    # Negative where x has the next boundary.
    lead = (wp.int64(first_x) + done_x * wp.int64(UNIT)) * size_y
    lead -= (wp.int64(first_y) + done_y * wp.int64(UNIT)) * size_x
    while left_x + left_y > 0 and not has_left(col, step_x, cols) and not has_left(row, step_y, rows):
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
    if left_x + left_y == 0 and col >= 0 and col < cols and row >= 0 and row < rows:
        if hit[n] != 0:
            wp.atomic_add(hits, row * cols + col, 1)
        else:
            wp.atomic_add(misses, row * cols + col, 1)
