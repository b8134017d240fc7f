"""Weights of particles from the log-likelihoods of sensors, at the highest temperature that leaves enough particles.

w_k = v exp(b_k (l - max l)), where v is the weight before, l the sum over sensors of temperature times log p, and b_k
= b / 2^k a ladder. The first rung with an effective sample size (sum w)^2 / sum w^2 of at least SHARE of that before
is taken; what is left of b belongs to the next stage of the correction (annealing: Neal, *Annealed importance
sampling*, 2001). Weights are rounded to integers below 2^53 / N, so that sums of them are exact in any order.

Recovery: augmented MCL, *Probabilistic Robotics* table 8.3, with the mean likelihood per beam.
"""

import functools
import math

import warp as wp

from .elementary import exp_of, log_of
from .prelude import kernel, precision
from .rungs import RUNGS, SCALE, SHARE, WEIGHT_SUMS, largest_of, left_of, rung_of, set_stage, tempered

PER_BEAM_SCALE, SLOW_RATE, FAST_RATE = (wp.constant(place) for place in (22, 23, 24))
MOST_INJECTED, TEMPERATURE = wp.constant(25), wp.constant(27)
EVIDENCE, SLOW, FAST, INJECTED = (wp.constant(place) for place in (48, 49, 50, 51))
NEVER = wp.constant(wp.float64(-math.inf))
ZERO, ONE = wp.constant(wp.float64(0.0)), wp.constant(wp.float64(1.0))
LARGEST_EXPONENT = wp.constant(wp.float64(700.0))
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
        stage: wp.int32,
    ):
        b = wp.tid()
        begin = b * block
        if begin >= particles:
            return
        high = largest_of(largest, blocks)
        left = left_of(state, stage)
        scale = settings[SCALE]
        weights = eight()
        squares = eight()
        old = ZERO + ZERO
        for n in range(begin, wp.min(begin + block, particles)):
            likelihood = tempered(score[n], high, left)
            prior = before[n]
            old += wp.floor(prior * scale)
            for k in range(8):
                weight = prior * likelihood
                weights[k] += wp.floor(weight * scale)
                squares[k] += wp.floor(weight * weight * scale)
                likelihood = wp.sqrt(likelihood)
        for k in range(8):
            sums[b * WEIGHT_SUMS + k] = weights[k]
            sums[b * WEIGHT_SUMS + RUNGS + k] = squares[k]
        sums[b * WEIGHT_SUMS + 2 * RUNGS] = old

    # Update the averages of the likelihood per beam, and the share of particles to inject.
    @wp.func
    def follow_evidence(
        total: wp.float64,
        before: wp.float64,
        largest: wp.float64,
        settings: wp.array(dtype=wp.float64),
        state: wp.array(dtype=wp.float64),
    ):
        if not wp.isinf(largest) and total > ZERO and before > ZERO:
            evidence = largest + log_of(total / before)
            mean = exp_of(wp.min(settings[PER_BEAM_SCALE] * evidence, LARGEST_EXPONENT))
            slow = mean
            fast = mean
            if state[SLOW] != ZERO:
                slow = state[SLOW] + settings[SLOW_RATE] * (mean - state[SLOW])
                fast = state[FAST] + settings[FAST_RATE] * (mean - state[FAST])
            share = ZERO
            if slow > ZERO:
                share = ONE - fast / slow
            state[EVIDENCE] = evidence
            state[SLOW] = slow
            state[FAST] = fast
            state[INJECTED] = wp.min(wp.max(share, ZERO), settings[MOST_INJECTED])

    # Add up the sums of all blocks: one work-item takes a column. At stage 0 the first follows the evidence.
    @kernel
    def sum_weights(
        sums: wp.array(dtype=wp.float64),
        largest: wp.array(dtype=wp.float64),
        settings: wp.array(dtype=wp.float64),
        state: wp.array(dtype=wp.float64),
        totals: wp.array(dtype=wp.float64),
        blocks: wp.int32,
        stage: wp.int32,
    ):
        column = wp.tid()
        if column >= WEIGHT_SUMS:
            return
        total = ZERO + ZERO
        before = ZERO + ZERO
        for b in range(blocks):
            total += sums[b * WEIGHT_SUMS + column]
            before += sums[b * WEIGHT_SUMS + 2 * RUNGS]
        totals[column] = total
        if stage == 0 and column == 0:
            follow_evidence(total, before, largest_of(largest, blocks), settings, state)

    # Choose the rung, and set the weights and their exact cumulative sums: one work-item takes a block. The first
    # writes the stage's state.
    @kernel
    def set_weights(
        score: wp.array(dtype=wp.float64),
        before: wp.array(dtype=wp.float64),
        largest: wp.array(dtype=wp.float64),
        sums: wp.array(dtype=wp.float64),
        totals: wp.array(dtype=wp.float64),
        settings: wp.array(dtype=wp.float64),
        state: wp.array(dtype=wp.float64),
        weight: wp.array(dtype=wp.float64),
        ends: wp.array(dtype=wp.float64),
        particles: wp.int32,
        block: wp.int32,
        blocks: wp.int32,
        stage: wp.int32,
        stages: wp.int32,
    ):
        b = wp.tid()
        begin = b * block
        if begin >= particles:
            return
        scale = settings[SCALE]
        left = left_of(state, stage)
        high = largest_of(largest, blocks)
        rung = int(0)
        if left > ZERO:
            rung = rung_of(totals, settings, settings[SHARE] * wp.float64(particles))
        total = ZERO + ZERO
        for i in range(b):
            total += sums[i * WEIGHT_SUMS + rung]
        for n in range(begin, wp.min(begin + block, particles)):
            likelihood = tempered(score[n], high, left)
            for _k in range(rung):
                likelihood = wp.sqrt(likelihood)
            chosen = before[n] * likelihood
            weight[n] = chosen
            total += wp.floor(chosen * scale)
            ends[n] = total
        if b == 0:
            set_stage(totals, settings, state, high, left, rung, particles, stage, stages)

    kernels = {"add_scores": add_scores, "weigh_particles": weigh_particles}
    return (kernels | {"sum_weights": sum_weights, "set_weights": set_weights})[name]
