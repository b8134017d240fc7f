"""Resampling of particles from exact cumulative weights, with jitter between stages and injected poses.

Systematic resampling draws at (n + u) / N of the total, stratified resampling at (n + u_n) / N: *Probabilistic
Robotics* table 4.4, and Kitagawa (1996). Residual resampling copies each particle by the integer part of its expected
number of copies, and draws the rest by the residual weights (Liu and Chen 1998). Between two stages of a correction a
drawn pose moves by a fraction of the difference between two other poses, so that moves scale with the spread of the
cloud (differential evolution: ter Braak 2006); differences between separate clusters are shortened. Injected poses come
from a pool: free cells, or the modes of a likelihood map.
"""

import warp as wp

from .draws import copies_of, copy_particle, draw_particle, found_at, found_residual, is_copied, mark_of, start_of
from .prelude import kernel

STRATIFIED, TOTAL, STAGE = (wp.constant(place) for place in (26, 1, 8))
WEIGHT_SUMS = wp.constant(17)
ZERO, RESIDUAL = wp.constant(wp.float64(0.0)), wp.constant(wp.float64(2.0))


@kernel
def count_copies(ends, state, sums, particles, block, blocks, drawn, stage):
    """Count the deterministic copies of a block; the other columns are 0: one work-item takes a block."""
    b = wp.tid()
    begin = b * block
    if begin >= particles:
        return
    total = state[stage * STAGE + TOTAL]
    counted = ZERO + ZERO
    for n in range(begin, wp.min(begin + block, particles)):
        counted += copies_of(ends, total, drawn, n)
    sums[b * WEIGHT_SUMS] = counted
    for k in range(1, WEIGHT_SUMS):
        sums[b * WEIGHT_SUMS + k] = ZERO


@kernel
def set_copies(ends, state, sums, joined, copies, particles, block, blocks, fan, drawn, stage):
    """Set the cumulative numbers of deterministic copies: one work-item takes a block."""
    b = wp.tid()
    begin = b * block
    if begin >= particles:
        return
    total = state[stage * STAGE + TOTAL]
    counted = sums[b * WEIGHT_SUMS]
    if b >= fan:
        counted += joined[b / fan * WEIGHT_SUMS]
    for n in range(begin, wp.min(begin + block, particles)):
        counted += copies_of(ends, total, drawn, n)
        copies[n] = counted


@kernel
def draw_particles(source, weight, ends, copies, settings, state, pool, target, after, particles, drawn, stage):
    """Draw the particles of the next stage or step, or copy them where no resampling is due."""
    n = wp.tid()
    if n >= drawn:
        return
    total = state[stage * STAGE + TOTAL]
    if is_copied(state, stage, particles, drawn):
        copy_particle(source, weight, settings, total, target, after, particles, n)
        return
    index = wp.uint32(n)
    at = wp.float64(index)
    first = wp.uint32(0)
    if settings[STRATIFIED] > ZERO:
        first = index
    start = start_of(settings, stage, first)
    chosen = int(0)
    if settings[STRATIFIED] == RESIDUAL:
        if at < copies[particles - 1]:
            chosen = found_at(copies, at, particles)
        else:
            chosen = found_residual(ends, copies, start, total, particles, drawn)
    else:
        chosen = found_at(ends, mark_of((at + start) / wp.float64(drawn), total), particles)
    draw_particle(source, ends, settings, state, pool, target, after, particles, stage, n, chosen)
