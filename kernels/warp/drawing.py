"""Resampling of particles from exact cumulative weights, with jitter between stages and injected poses."""

import warp as wp

from gpusense.interface import constants as c

from .motion import wrap_once
from .philox import random_words, uniform_of
from .prelude import kernel

BY_RESIDUALS, LEAST_WEIGHT = wp.float64(c.RESIDUAL), wp.float64(1e-6)
ZERO, ONE, TWO = wp.float64(0.0), wp.float64(1.0), wp.float64(2.0)


@wp.func
def found_at(ends: wp.array(dtype=wp.float64), mark: wp.float64, particles: wp.int32):
    """Return the first index whose cumulative weight exceeds a mark."""
    low = int(0)
    high = particles - 1
    while low < high:
        middle = low + (high - low) // 2
        if ends[middle] > mark:
            high = middle
        else:
            low = middle + 1
    return low


@wp.func
def copies_of(ends: wp.array(dtype=wp.float64), total: wp.float64, drawn: wp.int32, n: wp.int32):
    """Return the deterministic copies of residual resampling: the integer part of the expected number of copies."""
    weight = ends[n]
    if n > 0:
        weight = ends[n] - ends[n - 1]
    copies = ZERO
    if total > ZERO:
        copies = wp.floor(wp.float64(drawn) * weight / total)
    return copies


@wp.func
def found_residual(
    ends: wp.array(dtype=wp.float64), copies: wp.array(dtype=wp.float64), fraction: wp.float64, total: wp.float64,
    particles: wp.int32, drawn: wp.int32,
):  # fmt: skip
    """Return the first index whose cumulative residual weight exceeds a fraction of all residual weights."""
    each = total / wp.float64(drawn)
    mark = fraction * (ends[particles - 1] - copies[particles - 1] * each)
    low = int(0)
    high = particles - 1
    while low < high:
        middle = low + (high - low) // 2
        if ends[middle] - copies[middle] * each > mark:
            high = middle
        else:
            low = middle + 1
    return low


@wp.func
def mark_of(fraction: wp.float64, total: wp.float64):
    """Return the mark at a fraction of the total, clamped to below the total."""
    return wp.min(wp.floor(fraction * total), total - ONE)


@wp.func
def is_copied(state: wp.array(dtype=wp.float64), stage: wp.int32, particles: wp.int32, drawn: wp.int32):
    """Return whether particles are copied, because no resampling is due."""
    due = state[stage * c.STAGE + c.RESAMPLED] != ZERO or drawn != particles
    return not due or not (state[stage * c.STAGE + c.TOTAL] > ZERO)


@wp.func
def copy_particle(
    source: wp.array(dtype=wp.float64), weight: wp.array(dtype=wp.float64), settings: wp.array(dtype=wp.float64),
    total: wp.float64, target: wp.array(dtype=wp.float64), after: wp.array(dtype=wp.float64), particles: wp.int32,
    n: wp.int32,
):  # fmt: skip
    """Copy particle n with its weight, relative to the mean weight."""
    copied = n % particles
    for axis in range(3):
        target[3 * n + axis] = source[3 * copied + axis]
    kept = ONE
    if total > ZERO:
        kept = wp.max(weight[copied] / (total / (settings[c.SCALE] * wp.float64(particles))), LEAST_WEIGHT)
        if weight[copied] == ZERO:
            kept = weight[copied]
    after[n] = kept


@wp.func
def words_of(settings: wp.array(dtype=wp.float64), stage: wp.int32, index: wp.uint32, stream: wp.int32):
    """Return the random words of a draw in a stream of its stage."""
    of_stage = wp.uint32(c.DRAW_STREAM + c.DRAW_STREAMS * stage + stream)
    step = wp.uint32(settings[c.STEP])
    return random_words(index, step, of_stage, wp.uint32(settings[c.SEED]), wp.uint32(settings[c.SEED + 1]))


@wp.func
def start_of(settings: wp.array(dtype=wp.float64), stage: wp.int32, index: wp.uint32):
    """Return the random number of a draw's mark; systematic resampling uses the number of index 0 for all draws."""
    words = words_of(settings, stage, index, 0)
    return uniform_of(words[0])


@wp.func
def draw_particle(
    source: wp.array(dtype=wp.float64), ends: wp.array(dtype=wp.float64), settings: wp.array(dtype=wp.float64),
    state: wp.array(dtype=wp.float64), pool: wp.array(dtype=wp.float64), target: wp.array(dtype=wp.float64),
    after: wp.array(dtype=wp.float64), particles: wp.int32, stage: wp.int32, n: wp.int32, chosen: wp.int32,
):  # fmt: skip
    """Draw particle n from the one with index chosen: move it by jitter where a stage follows, or inject a pose."""
    index = wp.uint32(n)
    x = source[3 * chosen]
    y = source[3 * chosen + 1]
    theta = source[3 * chosen + 2]
    after[n] = ONE
    if state[stage * c.STAGE + c.LEFT] > ZERO:
        total = state[stage * c.STAGE + c.TOTAL]
        words = words_of(settings, stage, index, 1)
        one = 3 * found_at(ends, mark_of(uniform_of(words[0]), total), particles)
        other = 3 * found_at(ends, mark_of(uniform_of(words[1]), total), particles)
        dx = source[one] - source[other]
        dy = source[one + 1] - source[other + 1]
        turn = wrap_once(source[one + 2] - source[other + 2])
        far_x = wp.max(wp.abs(dx), wp.abs(dy)) / settings[c.FARTHEST_X]
        far = wp.max(wp.max(far_x, wp.abs(turn) / settings[c.FARTHEST_THETA]), ONE)
        part = settings[c.JITTER] / far
        x += part * dx
        y += part * dy
        theta = wrap_once(theta + part * turn)
    if stage == 0 and state[c.INJECTED] > ZERO and settings[c.POOL] > ZERO:
        some = words_of(settings, stage, index, 2)
        more = words_of(settings, stage, index, 3)
        if uniform_of(some[0]) < state[c.INJECTED]:
            row = 3 * int(wp.min(wp.floor(uniform_of(some[1]) * settings[c.POOL]), settings[c.POOL] - ONE))
            x = pool[row] + (TWO * uniform_of(more[0]) - ONE) * settings[c.POOL + 1]
            y = pool[row + 1] + (TWO * uniform_of(more[1]) - ONE) * settings[c.POOL + 2]
            theta = wrap_once(pool[row + 2] + (TWO * uniform_of(more[2]) - ONE) * settings[c.POOL + 3])
    target[3 * n] = x
    target[3 * n + 1] = y
    target[3 * n + 2] = theta


@kernel
def count_copies(ends, state, sums, particles, block, blocks, drawn, stage):
    """Count the deterministic copies of a block; the other columns are 0: one work-item takes a block."""
    b = wp.tid()
    begin = b * block
    if begin >= particles:
        return
    total = state[stage * c.STAGE + c.TOTAL]
    counted = ZERO + ZERO
    for n in range(begin, wp.min(begin + block, particles)):
        counted += copies_of(ends, total, drawn, n)
    sums[b * c.WEIGHT_SUMS] = counted
    for k in range(1, c.WEIGHT_SUMS):
        sums[b * c.WEIGHT_SUMS + k] = ZERO


@kernel
def set_copies(ends, state, sums, joined, copies, particles, block, blocks, fan, drawn, stage):
    """Set the cumulative numbers of deterministic copies: one work-item takes a block."""
    b = wp.tid()
    begin = b * block
    if begin >= particles:
        return
    total = state[stage * c.STAGE + c.TOTAL]
    counted = sums[b * c.WEIGHT_SUMS]
    if b >= fan:
        counted += joined[b / fan * c.WEIGHT_SUMS]
    for n in range(begin, wp.min(begin + block, particles)):
        counted += copies_of(ends, total, drawn, n)
        copies[n] = counted


@kernel
def draw_particles(source, weight, ends, copies, settings, state, pool, target, after, particles, drawn, stage):
    """Draw the particles of the next stage or step, or copy them where no resampling is due."""
    n = wp.tid()
    if n >= drawn:
        return
    total = state[stage * c.STAGE + c.TOTAL]
    if is_copied(state, stage, particles, drawn):
        copy_particle(source, weight, settings, total, target, after, particles, n)
        return
    index = wp.uint32(n)
    at = wp.float64(index)
    first = wp.uint32(0)
    if settings[c.STRATIFIED] > ZERO:
        first = index
    start = start_of(settings, stage, first)
    chosen = int(0)
    if settings[c.STRATIFIED] == BY_RESIDUALS:
        if at < copies[particles - 1]:
            chosen = found_at(copies, at, particles)
        else:
            chosen = found_residual(ends, copies, start, total, particles, drawn)
    else:
        chosen = found_at(ends, mark_of((at + start) / wp.float64(drawn), total), particles)
    draw_particle(source, ends, settings, state, pool, target, after, particles, stage, n, chosen)
