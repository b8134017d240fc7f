"""The ladder of temperatures of a correction, and the state of its stages: b_k = b / 2^k, where b is what is left.

See weighing.py.

Recovery: augmented MCL, *Probabilistic Robotics* table 8.3, with the mean likelihood per beam.
"""

import math

import warp as wp

from .elementary import exp_of, log_of

SHARE, THRESHOLD, SCALE = (wp.constant(place) for place in (19, 20, 21))
PER_BEAM_SCALE, SLOW_RATE, FAST_RATE, MOST_INJECTED = (wp.constant(place) for place in (22, 23, 24, 25))
RUNGS, WEIGHT_SUMS = wp.constant(8), wp.constant(17)
# Places in the state: of a stage, and of what lasts.
LEFT, TOTAL, SAMPLE_SIZE, RESAMPLED, DEGENERATE, RUNG = (wp.constant(place) for place in range(6))
STAGE = wp.constant(8)
# 2^-(RUNGS - 1).
LOWEST = wp.constant(wp.float64(0.0078125))
EVIDENCE, SLOW, FAST, INJECTED = (wp.constant(place) for place in (48, 49, 50, 51))
LARGEST_EXPONENT = wp.constant(wp.float64(700.0))
NEVER = wp.constant(wp.float64(-math.inf))
ZERO, HALF, ONE = wp.constant(wp.float64(0.0)), wp.constant(wp.float64(0.5)), wp.constant(wp.float64(1.0))


# Return the largest score of all groups.
@wp.func
def largest_of(largest: wp.array(dtype=wp.float64), groups: wp.int32):
    high = largest[0]
    for g in range(1, groups):
        high = wp.max(high, largest[g])
    return high


# Return the largest score; -inf where all particles with a weight are impossible next to those without one.
@wp.func
def possible_of(totals: wp.array(dtype=wp.float64), largest: wp.float64):
    high = NEVER + ZERO
    if totals[RUNGS - 1] > ZERO:
        high = largest
    return high


# Return the column of sums with the weights of a rung; that of the weights before where none is possible.
@wp.func
def column_of(high: wp.float64, rung: wp.int32):
    column = rung
    if wp.isinf(high):
        column = 2 * RUNGS
    return column


# Return the likelihood of a score relative to the largest, on the last rung; 1 where none is possible or nothing is
# left. Its square belongs to the rung before: an error of 2^-53 grows to 2^-46 on the first rung.
@wp.func
def tempered(score: wp.float64, largest: wp.float64, left: wp.float64):
    value = ONE
    if not wp.isinf(largest) and left > ZERO:
        value = exp_of(LOWEST * left * (score - largest))
    return value


# Return the part of the temperature that earlier stages have left.
@wp.func
def left_of(state: wp.array(dtype=wp.float64), stage: wp.int32):
    left = ONE
    if stage > 0:
        left = state[(stage - 1) * STAGE + LEFT]
    return left


# Return the first rung with the effective sample size least, or the last rung.
@wp.func
def rung_of(totals: wp.array(dtype=wp.float64), settings: wp.array(dtype=wp.float64), least: wp.float64):
    rung = int(0)
    while rung < RUNGS - 1 and not (totals[rung] * totals[rung] >= least * settings[SCALE] * totals[RUNGS + rung]):
        rung += 1
    return rung


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


# Write the state of a stage that uses a rung; at stage 0, follow the evidence.
@wp.func
def set_stage(
    totals: wp.array(dtype=wp.float64),
    settings: wp.array(dtype=wp.float64),
    state: wp.array(dtype=wp.float64),
    high: wp.float64,
    left: wp.float64,
    rung: wp.int32,
    particles: wp.int32,
    stage: wp.int32,
    stages: wp.int32,
):
    if stage == 0:
        follow_evidence(totals[0], totals[2 * RUNGS], high, settings, state)
    size = totals[rung] * totals[rung] / (settings[SCALE] * totals[RUNGS + rung])
    part = left * ONE
    for _k in range(rung):
        part = part * HALF
    rest = left - part
    wanted = size < settings[THRESHOLD] * wp.float64(particles) or rest > ZERO
    if stage == 0 and state[INJECTED] > ZERO:
        wanted = True
    first = stage * STAGE
    state[first + LEFT] = wp.where(stage + 1 < stages, rest, ZERO)
    state[first + TOTAL] = totals[column_of(high, rung)]
    state[first + SAMPLE_SIZE] = size
    state[first + RESAMPLED] = wp.where(wanted, ONE, ZERO)
    state[first + DEGENERATE] = wp.where(wp.isinf(high), ONE, ZERO)
    state[first + RUNG] = part
