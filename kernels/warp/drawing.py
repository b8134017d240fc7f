"""Resampling of particles from exact cumulative weights, with jitter between stages and injected poses.

Systematic resampling draws at (n + u) / N of the total, stratified resampling at (n + u_n) / N: *Probabilistic
Robotics* table 4.4, and Kitagawa (1996). Between two stages of a correction a drawn pose moves by a fraction of the
difference of two others, whose spread is that of the cloud (differential evolution: ter Braak 2006); differences
between separate clusters are shortened. Injected poses come from a pool: free cells, or the modes of a likelihood map.
"""

import functools

import warp as wp

from . import draws
from .prelude import kernel

STRATIFIED, FIRST, DRAWN, TOTAL, STAGE = (wp.constant(place) for place in (26, 61, 63, 1, 8))
ZERO = wp.constant(wp.float64(0.0))


@functools.cache
def make(name, flags):
    """Make a kernel of the file for a set of flags."""
    of = draws.functions(frozenset())
    found_at, mark_of, is_copied, start_of = of.found_at, of.mark_of, of.is_copied, of.start_of
    copy_particle, draw_particle = of.copy_particle, of.draw_particle

    # Draw the particles of the next stage or step, or copy them where no resampling is due: one work-item takes a
    # particle.
    @kernel
    def draw_particles(
        source: wp.array(dtype=wp.float64),
        weight: wp.array(dtype=wp.float64),
        ends: wp.array(dtype=wp.float64),
        settings: wp.array(dtype=wp.float64),
        state: wp.array(dtype=wp.float64),
        pool: wp.array(dtype=wp.float64),
        target: wp.array(dtype=wp.float64),
        after: wp.array(dtype=wp.float64),
        particles: wp.int32,
        drawn: wp.int32,
        stage: wp.int32,
    ):
        n = wp.tid()
        if n >= drawn:
            return
        total = state[stage * STAGE + TOTAL]
        if is_copied(state, stage, particles, drawn):
            copy_particle(source, weight, settings, total, target, after, particles, n)
            return
        index = wp.uint32(settings[FIRST]) + wp.uint32(n)
        whole = wp.where(settings[DRAWN] > ZERO, settings[DRAWN], wp.float64(drawn))
        first = wp.uint32(0)
        if settings[STRATIFIED] > ZERO:
            first = index
        mark = mark_of((wp.float64(index) + start_of(settings, stage, first)) / whole, total)
        chosen = found_at(ends, mark, particles)
        draw_particle(source, ends, settings, state, pool, target, after, particles, stage, n, chosen)

    return {"draw_particles": draw_particles}[name]
