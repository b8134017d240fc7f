"""Weights of particles from the log-likelihoods of sensors, at the highest temperature that leaves enough particles.

w_k = v exp(b_k (l - max l)), where v is the previous weight, l the sum over sensors of temperature times log p, and b_k
= d b / 2^k a ladder of depth d. The first rung whose effective sample size (sum w)^2 / sum w^2 is at least SHARE of the
previous one is taken; the rest of b is left to the next stage of the correction (annealing: Neal, *Annealed importance
sampling*, 2001). Weights are rounded to integers below 2^53 / N, so that their sums are exact in any order.
"""

import warp as wp

from .prelude import kernel, loader, writer
from .tempering import (
    DEPTH,
    NEVER,
    RUNGS,
    SCALE,
    SHARE,
    WEIGHT_SUMS,
    column_of,
    eight,
    eight_at,
    largest_of,
    left_of,
    possible_of,
    rung_of,
    set_stage,
    sum_before,
    sum_eight,
    tempered,
)

TEMPERATURE = wp.constant(27)
ZERO = wp.constant(wp.float64(0.0))
load, write = loader(wp.float64), writer(wp.float64)
sixteen = wp.types.vector(length=16, dtype=wp.float64)


@kernel
def add_scores(log_p, settings, score, largest, particles, block, sensor):
    """Add a sensor's log-likelihoods times its temperature to the scores."""
    b = wp.tid()
    begin = b * block
    if begin >= particles:
        return
    temperature = settings[TEMPERATURE + sensor]
    high = wp.float64(0.0) + NEVER
    for n in range(begin, wp.min(begin + block, particles)):
        value = temperature * wp.float64(log_p[n])
        if sensor > 0:
            value = score[n] + value
        score[n] = value
        high = wp.max(high, value)
    largest[b] = high


@kernel
def join_scores(scores, largest, blocks, fan):
    """Find the largest score of each group of fan blocks: one work-item takes a group of blocks."""
    g = wp.tid()
    begin = g * fan
    if begin < blocks:
        largest[g] = largest_of(scores, begin, wp.min(begin + fan, blocks))


@kernel
def weigh_particles(score, before, largest, settings, state, sums, highest, particles, block, blocks, groups, stage):
    """Sum the integer weights of each block on each rung, their squares, and the previous weights."""
    b = wp.tid()
    begin = b * block
    if begin >= particles:
        return
    high = largest_of(largest, 0, groups)
    left = left_of(state, stage) * settings[DEPTH]
    scale = settings[SCALE]
    end = wp.min(begin + block, particles)
    weights = eight()
    squares = eight()
    old = ZERO + ZERO
    n = begin + 0
    while n < end:
        scores = eight_at(score, n, end, NEVER)
        prior = eight_at(before, n, end, ZERO)
        likelihood = tempered(scores, high, left)
        old += sum_eight(prior * scale)
        for k in range(7, -1, -1):
            weight = wp.cw_mul(prior, likelihood)
            weights[k] += sum_eight(weight * scale)
            squares[k] += sum_eight(wp.cw_mul(weight, weight) * scale)
            likelihood = wp.cw_mul(likelihood, likelihood)
        n += 8
    for k in range(8):
        sums[b * WEIGHT_SUMS + k] = weights[k]
        sums[b * WEIGHT_SUMS + RUNGS + k] = squares[k]
    sums[b * WEIGHT_SUMS + 2 * RUNGS] = old
    if b == 0:
        highest[0] = high


@kernel
def join_rows(sums, joined, rows, columns, fan):
    """Add up groups of fan rows of sums in order; a row becomes the sum of the rows before it in its group."""
    i = wp.tid()
    row = i / columns * fan
    if row >= rows:
        return
    end = wp.min(row + fan, rows)
    total = ZERO + ZERO
    while row < end:
        # All are read before any is added.
        number = sixteen()
        place = row * columns + i % columns
        for k in range(16):
            if row + k < end:
                number[k] = load(sums, place + k * columns)
        for k in range(16):
            if row + k < end:
                write(sums, place + k * columns, total)
            total += number[k]
        row += 16
    joined[i] = total


@kernel
def set_weights(
    score, before, highest, sums, joined, totals, settings, state, weight, ends, particles, block, blocks, fan,
    stage, stages,
):  # fmt: skip
    """Choose the rung, and set the weights and their exact cumulative sums: one work-item takes a block."""
    b = wp.tid()
    if b > blocks:
        return
    scale = settings[SCALE]
    left = left_of(state, stage)
    high = possible_of(totals, highest[0])
    rung = int(0)
    if left > ZERO:
        rung = rung_of(totals, settings, settings[SHARE] * wp.float64(particles))
    if b == blocks:
        set_stage(totals, settings, state, high, left, rung, particles, stage, stages)
        return
    total = sum_before(sums, joined, b, fan, column_of(high, rung))
    low = left * settings[DEPTH]
    n = b * block
    end = wp.min(n + block, particles)
    while n < end:
        scores = eight_at(score, n, end, NEVER)
        prior = eight_at(before, n, end, ZERO)
        likelihood = tempered(scores, high, low)
        for _k in range(rung, RUNGS - 1):
            likelihood = wp.cw_mul(likelihood, likelihood)
        chosen = wp.cw_mul(prior, likelihood)
        for i in range(8):
            total += wp.floor(chosen[i] * scale)
            if n + i < end:
                write(weight, n + i, chosen[i])
                write(ends, n + i, total)
        n += 8
