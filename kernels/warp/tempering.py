"""The ladder of temperatures of a correction, and the state of its stages: b_k = d b / 2^k, where b is the part of the
temperature that is left.

The depth d is 1. If the last rung leaves too few particles, the host repeats the stage with a smaller d.

See weighing.py.

Recovery: augmented MCL, *Probabilistic Robotics* table 8.3, with the mean likelihood per beam.
"""

import math

import warp as wp

from .elementary import exp_of, log_of
from .prelude import reader

SHARE, THRESHOLD, SCALE = (wp.constant(place) for place in (19, 20, 21))
PER_BEAM_SCALE, SLOW_RATE, FAST_RATE, MOST_INJECTED = (wp.constant(place) for place in (22, 23, 24, 25))
RUNGS, WEIGHT_SUMS = wp.constant(8), wp.constant(17)
DEPTH = wp.constant(60)
# Places in the state: numbers of a stage, then numbers that outlast it.
LEFT, TOTAL, SAMPLE_SIZE, RESAMPLED, DEGENERATE, RUNG = (wp.constant(place) for place in range(6))
STAGE = wp.constant(8)
# 2^-(RUNGS - 1).
LOWEST = wp.constant(wp.float64(0.0078125))
EVIDENCE, SLOW, FAST, INJECTED = (wp.constant(place) for place in (48, 49, 50, 51))
LARGEST_EXPONENT = wp.constant(wp.float64(700.0))
NEVER = wp.constant(wp.float64(-math.inf))
ZERO, HALF, ONE = wp.constant(wp.float64(0.0)), wp.constant(wp.float64(0.5)), wp.constant(wp.float64(1.0))
eight = wp.types.vector(length=8, dtype=wp.float64)
number_at = reader(wp.float64)


@wp.func
def eight_at(values: wp.array(dtype=wp.float64), first: wp.int32, end: wp.int32, missing: wp.float64):
    """Return 8 numbers from first on, and missing in place of those from end on."""
    found = eight(missing)
    for i in range(8):
        if first + i < end:
            found[i] = number_at(values, first + i)
    return found


@wp.func
def sum_eight(numbers: eight):
    """Return the sum of 8 numbers, rounded down to integers."""
    total = wp.floor(numbers[0])
    for i in range(1, 8):
        total += wp.floor(numbers[i])
    return total


@wp.func
def largest_of(largest: wp.array(dtype=wp.float64), begin: wp.int32, end: wp.int32):
    """Return the largest of the scores from begin to before end."""
    high = NEVER + ZERO
    g = begin + 0
    while g < end:
        one = eight_at(largest, g, end, NEVER)
        two = eight_at(largest, g + 8, end, NEVER)
        high = wp.max(high, wp.max(wp.max(one), wp.max(two)))
        g += 16
    return high


@wp.func
def possible_of(totals: wp.array(dtype=wp.float64), largest: wp.float64):
    """Return the largest score; -inf if all particles with a weight are impossible next to particles without."""
    high = NEVER + ZERO
    if totals[RUNGS - 1] > ZERO:
        high = largest
    return high


@wp.func
def column_of(high: wp.float64, rung: wp.int32):
    """Return the column of sums with the weights of a rung; of the previous weights where none is possible."""
    column = rung
    if wp.isinf(high):
        column = 2 * RUNGS
    return column


@wp.func
def sum_before(
    sums: wp.array(dtype=wp.float64), joined: wp.array(dtype=wp.float64), b: wp.int32, fan: wp.int32, column: wp.int32
):
    """Return the sum of a column over all blocks before one."""
    total = number_at(sums, b * WEIGHT_SUMS + column)
    if b >= fan:
        total += number_at(joined, b / fan * WEIGHT_SUMS + column)
    return total


@wp.func
def tempered(scores: eight, largest: wp.float64, left: wp.float64):
    """Return the likelihoods of 8 scores relative to the largest, on the last rung."""
    found = eight(ONE)
    if not wp.isinf(largest) and left > ZERO:
        for i in range(8):
            found[i] = exp_of(LOWEST * left * (scores[i] - largest))
    return found


@wp.func
def left_of(state: wp.array(dtype=wp.float64), stage: wp.int32):
    """Return the part of the temperature that earlier stages have left."""
    left = ONE
    if stage > 0:
        left = state[(stage - 1) * STAGE + LEFT]
    return left


@wp.func
def rung_of(totals: wp.array(dtype=wp.float64), settings: wp.array(dtype=wp.float64), least: wp.float64):
    """Return the first rung with the effective sample size least, or the last rung."""
    rung = RUNGS - 1
    for i in range(7):
        k = 6 - i
        total = number_at(totals, k)
        if total * total >= least * number_at(settings, SCALE) * number_at(totals, RUNGS + k):
            rung = k
    return rung


@wp.func
def follow_evidence(
    total: wp.float64, before: wp.float64, largest: wp.float64, settings: wp.array(dtype=wp.float64),
    state: wp.array(dtype=wp.float64),
):  # fmt: skip
    """Update the averages of the likelihood per beam, and the share of particles to inject."""
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


@wp.func
def set_stage(
    totals: wp.array(dtype=wp.float64), settings: wp.array(dtype=wp.float64), state: wp.array(dtype=wp.float64),
    high: wp.float64, left: wp.float64, rung: wp.int32, particles: wp.int32, stage: wp.int32, stages: wp.int32,
):  # fmt: skip
    """Write the state of a stage that uses a rung; at stage 0, follow the evidence of the whole temperature."""
    if stage == 0 and settings[DEPTH] == ONE:
        follow_evidence(totals[0], totals[2 * RUNGS], high, settings, state)
    size = totals[rung] * totals[rung] / (settings[SCALE] * totals[RUNGS + rung])
    part = left * settings[DEPTH]
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
