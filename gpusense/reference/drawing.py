"""Resampling of particles from exact cumulative weights, with jitter between stages and injected poses.

Systematic resampling draws at (n + u) / N of the total, stratified resampling at (n + u_n) / N: *Probabilistic
Robotics* table 4.4, and Kitagawa (1996). Residual resampling copies each particle by the integer part of its expected
number of copies, and draws the rest by the residual weights (Liu and Chen 1998). Between two stages of a correction a
drawn pose moves by a fraction of the difference between two other poses, so that moves scale with the spread of the
cloud (differential evolution: ter Braak 2006); differences between separate clusters are shortened. Injected poses come
from a pool: free cells, or the modes of a likelihood map.
"""

import numpy as np

from gpusense.interface.constants import RESIDUAL, STAGE, STRATIFIED, TOTAL, WEIGHT_SUMS
from gpusense.reference.draws import (
    copies_of,
    copy_particle,
    draw_particle,
    found_at,
    found_residual,
    is_copied,
    mark_of,
    start_of,
)


def count_copies(flags, ends, state, sums, particles, block, blocks, drawn, stage):
    """Count the deterministic copies of each block; the other columns are 0."""
    copies = copies_of(ends[:particles], state[stage * STAGE + TOTAL], drawn)
    table = sums[: blocks * WEIGHT_SUMS].reshape(blocks, WEIGHT_SUMS)
    table[:] = 0.0
    table[:, 0] = np.add.reduceat(copies, np.arange(0, particles, block))


def set_copies(flags, ends, state, sums, joined, copies, particles, block, blocks, fan, drawn, stage):
    """Set the cumulative numbers of deterministic copies."""
    copies[:particles] = np.cumsum(copies_of(ends[:particles], state[stage * STAGE + TOTAL], drawn))


def draw_particles(flags, source, weight, ends, copies, settings, state, pool, target, after, particles, drawn, stage):
    """Draw the particles of the next stage or step, or copy them where no resampling is due."""
    n, own = np.arange(drawn), state[stage * STAGE : (stage + 1) * STAGE]
    if is_copied(own, particles, drawn):
        copy_particle(source[: 3 * particles], weight, settings, own, target, after, particles, n)
        return
    start = start_of(settings, stage, n if settings[STRATIFIED] > 0.0 else np.zeros(1, np.uint64))
    if settings[STRATIFIED] == RESIDUAL:
        certain = found_at(copies, n.astype(np.float64), particles)
        rest = found_residual(ends, copies, start, own[TOTAL], particles, drawn)
        chosen = np.where(n < copies[particles - 1], certain, rest)
    else:
        chosen = found_at(ends, mark_of((n + start) / drawn, own[TOTAL]), particles)
    draw_particle(source, ends, settings, state, pool, target, after, particles, stage, n, chosen)
