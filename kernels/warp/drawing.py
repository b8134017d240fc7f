"""Resampling of particles from exact cumulative weights, with jitter between stages and injected poses.

Systematic resampling draws at (n + u) / N of the total, stratified resampling at (n + u_n) / N: *Probabilistic
Robotics* table 4.4, and Kitagawa (1996). Between two stages of a correction a drawn pose moves by a fraction of the
difference of two others, whose spread is that of the cloud (differential evolution: ter Braak 2006); differences
between separate clusters are shortened. Injected poses come from a pool: free cells, or the modes of a likelihood map.
"""

import functools

import warp as wp

from . import motion, philox
from .prelude import kernel

SEED, STEP, JITTER, FARTHEST_X, FARTHEST_THETA, POOL = (wp.constant(place) for place in (0, 2, 12, 13, 14, 15))
SCALE, STRATIFIED, FIRST, WHOLE, DRAWN = (wp.constant(place) for place in (21, 26, 61, 62, 63))
LEFT, TOTAL, RESAMPLED, STAGE, INJECTED = (wp.constant(place) for place in (0, 1, 3, 8, 51))
DRAW_STREAM, DRAW_STREAMS = wp.constant(16), wp.constant(4)
LEAST_WEIGHT = wp.constant(wp.float64(1e-6))
ZERO, ONE, TWO = wp.constant(wp.float64(0.0)), wp.constant(wp.float64(1.0)), wp.constant(wp.float64(2.0))


@functools.cache
def make(name, flags):
    """Make a kernel of the file for a set of flags."""
    wrap_once = motion.functions(frozenset()).wrap_once
    numbers = philox.functions(frozenset())
    random_words, uniform_of = numbers.random_words, numbers.uniform_of

    # Return the first index whose cumulative weight exceeds a mark.
    @wp.func
    def found_at(ends: wp.array(dtype=wp.float64), mark: wp.float64, particles: wp.int32):
        low = int(0)
        high = particles - 1
        while low < high:
            middle = low + (high - low) // 2
            if ends[middle] > mark:
                high = middle
            else:
                low = middle + 1
        return low

    # Return the mark at a fraction of the total, below the total.
    @wp.func
    def mark_of(fraction: wp.float64, total: wp.float64):
        return wp.min(wp.floor(fraction * total), total - ONE)

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
        if (state[stage * STAGE + RESAMPLED] == ZERO and drawn == particles) or not total > ZERO:
            copied = n % particles
            for axis in range(3):
                target[3 * n + axis] = source[3 * copied + axis]
            kept = ONE
            if total > ZERO:
                whole = wp.where(settings[WHOLE] > ZERO, settings[WHOLE], wp.float64(particles))
                kept = wp.max(weight[copied] / (total / (settings[SCALE] * whole)), LEAST_WEIGHT)
                if weight[copied] == ZERO:
                    kept = weight[copied]
            after[n] = kept
            return
        step = wp.uint32(settings[STEP])
        key_0 = wp.uint32(settings[SEED])
        key_1 = wp.uint32(settings[SEED + 1])
        stream = wp.uint32(DRAW_STREAM + DRAW_STREAMS * stage)
        index = wp.uint32(settings[FIRST]) + wp.uint32(n)
        first = wp.uint32(0)
        if settings[STRATIFIED] > ZERO:
            first = index
        start = random_words(first, step, stream, key_0, key_1)
        next_whole = wp.where(settings[DRAWN] > ZERO, settings[DRAWN], wp.float64(drawn))
        fraction = (wp.float64(index) + uniform_of(start[0])) / next_whole
        chosen = 3 * found_at(ends, mark_of(fraction, total), particles)
        x = source[chosen]
        y = source[chosen + 1]
        theta = source[chosen + 2]
        after[n] = ONE
        if state[stage * STAGE + LEFT] > ZERO:
            words = random_words(index, step, stream + wp.uint32(1), key_0, key_1)
            one = 3 * found_at(ends, mark_of(uniform_of(words[0]), total), particles)
            other = 3 * found_at(ends, mark_of(uniform_of(words[1]), total), particles)
            dx = source[one] - source[other]
            dy = source[one + 1] - source[other + 1]
            turn = wrap_once(source[one + 2] - source[other + 2])
            far_x = wp.max(wp.abs(dx), wp.abs(dy)) / settings[FARTHEST_X]
            far = wp.max(wp.max(far_x, wp.abs(turn) / settings[FARTHEST_THETA]), ONE)
            part = settings[JITTER] / far
            x += part * dx
            y += part * dy
            theta = wrap_once(theta + part * turn)
        if stage == 0 and state[INJECTED] > ZERO and settings[POOL] > ZERO:
            some = random_words(index, step, stream + wp.uint32(2), key_0, key_1)
            more = random_words(index, step, stream + wp.uint32(3), key_0, key_1)
            if uniform_of(some[0]) < state[INJECTED]:
                row = 3 * int(wp.min(wp.floor(uniform_of(some[1]) * settings[POOL]), settings[POOL] - ONE))
                x = pool[row] + (TWO * uniform_of(more[0]) - ONE) * settings[POOL + 1]
                y = pool[row + 1] + (TWO * uniform_of(more[1]) - ONE) * settings[POOL + 2]
                theta = wrap_once(pool[row + 2] + (TWO * uniform_of(more[2]) - ONE) * settings[POOL + 3])
        target[3 * n] = x
        target[3 * n + 1] = y
        target[3 * n + 2] = theta

    return {"draw_particles": draw_particles}[name]
