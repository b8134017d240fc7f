"""Weights of particles from the log-likelihoods of sensors, at the highest temperature that leaves enough particles.

w_k = v exp(b_k (l - max l)), where v is the weight before, l the sum over sensors of temperature times log p, and b_k
= b / 2^k a ladder. The first rung with an effective sample size (sum w)^2 / sum w^2 of at least SHARE of that before
is taken; what is left of b belongs to the next stage of the correction (annealing: Neal, *Annealed importance
sampling*, 2001). Weights are rounded to integers below 2^53 / N, so that sums of them are exact in any order.
"""

import functools

import warp as wp

from .prelude import kernel, precision
from .rungs import (
    NEVER,
    RUNGS,
    SCALE,
    SHARE,
    WEIGHT_SUMS,
    column_of,
    largest_of,
    left_of,
    possible_of,
    rung_of,
    set_stage,
    tempered,
)

TEMPERATURE = wp.constant(27)
ZERO = wp.constant(wp.float64(0.0))
eight = wp.types.vector(length=8, dtype=wp.float64)


@functools.cache
def make(name, flags):
    """Make a kernel of the file for a set of flags."""
    real = precision(flags).real

    # Add a sensor's log-likelihoods times its temperature to the scores, which sensor 0 begins, and find the largest:
    # one work-item takes a block of particles.
    @kernel
    def add_scores(
        log_p: wp.array(dtype=real),
        settings: wp.array(dtype=wp.float64),
        score: wp.array(dtype=wp.float64),
        largest: wp.array(dtype=wp.float64),
        particles: wp.int32,
        block: wp.int32,
        sensor: wp.int32,
    ):
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

    # Find the largest score of each fan blocks: one work-item takes a group of blocks.
    @kernel
    def join_scores(
        scores: wp.array(dtype=wp.float64),
        largest: wp.array(dtype=wp.float64),
        blocks: wp.int32,
        fan: wp.int32,
    ):
        g = wp.tid()
        begin = g * fan
        if begin >= blocks:
            return
        high = scores[begin]
        for b in range(begin + 1, wp.min(begin + fan, blocks)):
            high = wp.max(high, scores[b])
        largest[g] = high

    # Sum the integer weights of each block on each rung, their squares, and the weights before: one work-item takes a
    # block.
    @kernel
    def weigh_particles(
        score: wp.array(dtype=wp.float64),
        before: wp.array(dtype=wp.float64),
        largest: wp.array(dtype=wp.float64),
        settings: wp.array(dtype=wp.float64),
        state: wp.array(dtype=wp.float64),
        sums: wp.array(dtype=wp.float64),
        particles: wp.int32,
        block: wp.int32,
        blocks: wp.int32,
        groups: wp.int32,
        stage: wp.int32,
    ):
        b = wp.tid()
        begin = b * block
        if begin >= particles:
            return
        high = largest_of(largest, groups)
        left = left_of(state, stage)
        scale = settings[SCALE]
        weights = eight()
        squares = eight()
        old = ZERO + ZERO
        for n in range(begin, wp.min(begin + block, particles)):
            likelihood = tempered(score[n], high, left)
            prior = before[n]
            old += wp.floor(prior * scale)
            for k in range(7, -1, -1):
                weight = prior * likelihood
                weights[k] += wp.floor(weight * scale)
                squares[k] += wp.floor(weight * weight * scale)
                likelihood = likelihood * likelihood
        for k in range(8):
            sums[b * WEIGHT_SUMS + k] = weights[k]
            sums[b * WEIGHT_SUMS + RUNGS + k] = squares[k]
        sums[b * WEIGHT_SUMS + 2 * RUNGS] = old

    # Add up each fan rows of sums, one after the other: one work-item takes a column of a group of rows.
    @kernel
    def join_rows(
        sums: wp.array(dtype=wp.float64),
        joined: wp.array(dtype=wp.float64),
        rows: wp.int32,
        columns: wp.int32,
        fan: wp.int32,
    ):
        i = wp.tid()
        begin = i / columns * fan
        if begin >= rows:
            return
        total = ZERO + ZERO
        for row in range(begin, wp.min(begin + fan, rows)):
            total += sums[row * columns + i % columns]
        joined[i] = total

    # Choose the rung, and set the weights and their exact cumulative sums: one work-item takes a block. The first
    # writes the stage's state.
    @kernel
    def set_weights(
        score: wp.array(dtype=wp.float64),
        before: wp.array(dtype=wp.float64),
        largest: wp.array(dtype=wp.float64),
        sums: wp.array(dtype=wp.float64),
        joined: wp.array(dtype=wp.float64),
        totals: wp.array(dtype=wp.float64),
        settings: wp.array(dtype=wp.float64),
        state: wp.array(dtype=wp.float64),
        weight: wp.array(dtype=wp.float64),
        ends: wp.array(dtype=wp.float64),
        particles: wp.int32,
        block: wp.int32,
        blocks: wp.int32,
        fan: wp.int32,
        groups: wp.int32,
        stage: wp.int32,
        stages: wp.int32,
    ):
        b = wp.tid()
        begin = b * block
        if begin >= particles:
            return
        scale = settings[SCALE]
        left = left_of(state, stage)
        high = possible_of(totals, largest_of(largest, groups))
        rung = int(0)
        if left > ZERO:
            rung = rung_of(totals, settings, settings[SHARE] * wp.float64(particles))
        column = column_of(high, rung)
        total = ZERO + ZERO
        for g in range(b / fan):
            total += joined[g * WEIGHT_SUMS + column]
        for i in range(b - b % fan, b):
            total += sums[i * WEIGHT_SUMS + column]
        for n in range(begin, wp.min(begin + block, particles)):
            likelihood = tempered(score[n], high, left)
            for _k in range(rung, RUNGS - 1):
                likelihood = likelihood * likelihood
            chosen = before[n] * likelihood
            weight[n] = chosen
            total += wp.floor(chosen * scale)
            ends[n] = total
        if b == 0:
            set_stage(totals, settings, state, high, left, rung, particles, stage, stages)

    kernels = {"add_scores": add_scores, "join_scores": join_scores, "weigh_particles": weigh_particles}
    return (kernels | {"join_rows": join_rows, "set_weights": set_weights})[name]
