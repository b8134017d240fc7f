"""An order of particles in which neighbours have similar positions and headings."""

import warp as wp

from gpusense.interface.constants import ALL_BINS, BINS, STRETCH

from .prelude import kernel, work_item
from .ray import turn_of
from .types import real, vec2, vec4

# Sampled particles.
SAMPLES = 256
stretch_counts = wp.types.vector(length=16, dtype=wp.int32)
ZERO, ONE = real(0.0), real(1.0)
# Units of a turn.
TURN = real(65536.0)
HALF_TURN, WHOLE_TURN = 32768, 65536
PARTS = real(32.0)


@wp.func
def relative_turn(pose: vec4, other: vec4):
    """Return the heading relative to the first particle's, from -TURN / 2 to TURN / 2."""
    turn = int(turn_of(vec2(pose.z * other.z + pose.w * other.w, pose.w * other.z - pose.z * other.w)) * TURN)
    return wp.where(turn > HALF_TURN, turn - WHOLE_TURN, turn)


@kernel
def order_bounds(pose_cell, pose, bounds, bins, particles):
    """Clear the bins and find the bounds."""
    bin = work_item(wp.tid())
    if bin >= ALL_BINS:
        return
    bins[bin] = 0
    if bin == 0:
        bounds[6] = 0
    if bin >= SAMPLES:
        return
    n = int(wp.int64(bin) * wp.int64(particles) // wp.int64(SAMPLES))
    turn = relative_turn(pose[n], pose[0])
    wp.atomic_max(bounds, 0, -pose_cell[n].y)
    wp.atomic_max(bounds, 1, pose_cell[n].y)
    wp.atomic_max(bounds, 2, -pose_cell[n].x)
    wp.atomic_max(bounds, 3, pose_cell[n].x)
    wp.atomic_max(bounds, 4, -turn)
    wp.atomic_max(bounds, 5, turn)


@wp.func
def part_of(value: wp.int32, least: wp.int32, most: wp.int32):
    """Return the index of one of BINS equal parts of the bounds; the outermost parts hold values beyond them."""
    part = (real(value) - real(least)) * (PARTS / (real(most) - real(least) + ONE))
    return wp.where(part < ZERO, 0, wp.where(part >= PARTS, BINS - 1, int(part)))


@kernel
def order_count(pose_cell, pose, bounds, bins, bin_of, particles):
    """Find the bin of each particle, and count it there. One work-item takes a particle."""
    n = work_item(wp.tid())
    if n >= particles:
        return
    row = part_of(pose_cell[n].y, -bounds[0], bounds[1])
    col = part_of(pose_cell[n].x, -bounds[2], bounds[3])
    turn = part_of(relative_turn(pose[n], pose[0]), -bounds[4], bounds[5])
    bin = (row * BINS + col) * BINS + turn
    bin_of[n] = bin
    wp.atomic_add(bins, bin, 1)


@kernel
def order_starts(bounds, bins):
    """Replace the counts of bins by the indices at which they begin."""
    stretch = work_item(wp.tid())
    if stretch >= ALL_BINS // STRETCH:
        return
    begin = stretch * STRETCH
    # All are read before any is used, so that a work-item waits once for them.
    counts = stretch_counts()
    for i in range(STRETCH):
        counts[i] = bins[begin + i]
    total = int(0)
    for i in range(STRETCH):
        total += counts[i]
    start = int(wp.atomic_add(bounds, 6, total))
    for i in range(STRETCH):
        bins[begin + i] = start
        start += counts[i]


@kernel
def order_fill(bin_of, bins, order, particles):
    """Put each particle at the next index of its bin. One work-item takes a particle."""
    n = work_item(wp.tid())
    if n >= particles:
        return
    order[wp.atomic_add(bins, bin_of[n], 1)] = n
