"""Weights of particles from the log-likelihoods of sensors, at the highest temperature that leaves enough particles."""

import math

import warp as wp

from gpusense.interface import constants as c

from .elementary import exp_of, log_of
from .prelude import kernel, loader, reader, writer

LOWEST_RUNG = wp.float64(c.LOWEST)
LARGEST_EXPONENT = wp.float64(700.0)
NEVER = wp.float64(-math.inf)
ZERO, HALF, ONE = wp.float64(0.0), wp.float64(0.5), wp.float64(1.0)
eight = wp.types.vector(length=8, dtype=wp.float64)
number_at = reader(wp.float64)
load, write = loader(wp.float64), writer(wp.float64)
sixteen = wp.types.vector(length=16, dtype=wp.float64)


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
    if totals[c.RUNGS - 1] > ZERO:
        high = largest
    return high


@wp.func
def column_of(high: wp.float64, rung: wp.int32):
    """Return the column of sums with the weights of a rung; of the previous weights where none is possible."""
    column = rung
    if wp.isinf(high):
        column = 2 * c.RUNGS
    return column


@wp.func
def sum_before(
    sums: wp.array(dtype=wp.float64), joined: wp.array(dtype=wp.float64), b: wp.int32, fan: wp.int32, column: wp.int32
):
    """Return the sum of a column over all blocks before one."""
    total = number_at(sums, b * c.WEIGHT_SUMS + column)
    if b >= fan:
        total += number_at(joined, b / fan * c.WEIGHT_SUMS + column)
    return total


@wp.func
def tempered(scores: eight, largest: wp.float64, left: wp.float64):
    """Return the likelihoods of 8 scores relative to the largest, on the last rung."""
    found = eight(ONE)
    if not wp.isinf(largest) and left > ZERO:
        for i in range(8):
            found[i] = exp_of(LOWEST_RUNG * left * (scores[i] - largest))
    return found


@wp.func
def left_of(state: wp.array(dtype=wp.float64), stage: wp.int32):
    """Return the part of the temperature that earlier stages have left."""
    left = ONE
    if stage > 0:
        left = state[(stage - 1) * c.STAGE + c.LEFT]
    return left


@wp.func
def rung_of(totals: wp.array(dtype=wp.float64), settings: wp.array(dtype=wp.float64), least: wp.float64):
    """Return the first rung with the effective sample size least, or the last rung."""
    rung = c.RUNGS - 1
    for i in range(7):
        k = 6 - i
        total = number_at(totals, k)
        if total * total >= least * number_at(settings, c.SCALE) * number_at(totals, c.RUNGS + k):
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
        mean = exp_of(wp.min(settings[c.PER_BEAM_SCALE] * evidence, LARGEST_EXPONENT))
        slow = mean
        fast = mean
        if state[c.SLOW] != ZERO:
            slow = state[c.SLOW] + settings[c.SLOW_RATE] * (mean - state[c.SLOW])
            fast = state[c.FAST] + settings[c.FAST_RATE] * (mean - state[c.FAST])
        share = ZERO
        if slow > ZERO:
            share = ONE - fast / slow
        state[c.EVIDENCE] = evidence
        state[c.SLOW] = slow
        state[c.FAST] = fast
        state[c.INJECTED] = wp.min(wp.max(share, ZERO), settings[c.MOST_INJECTED])


@wp.func
def set_stage(
    totals: wp.array(dtype=wp.float64), settings: wp.array(dtype=wp.float64), state: wp.array(dtype=wp.float64),
    high: wp.float64, left: wp.float64, rung: wp.int32, particles: wp.int32, stage: wp.int32, stages: wp.int32,
):  # fmt: skip
    """Write the state of a stage that uses a rung; at stage 0, follow the evidence of the whole temperature."""
    if stage == 0 and settings[c.DEPTH] == ONE:
        follow_evidence(totals[0], totals[2 * c.RUNGS], high, settings, state)
    size = totals[rung] * totals[rung] / (settings[c.SCALE] * totals[c.RUNGS + rung])
    part = left * settings[c.DEPTH]
    for _k in range(rung):
        part = part * HALF
    rest = left - part
    wanted = size < settings[c.THRESHOLD] * wp.float64(particles) or rest > ZERO
    if stage == 0 and state[c.INJECTED] > ZERO:
        wanted = True
    first = stage * c.STAGE
    state[first + c.LEFT] = wp.where(stage + 1 < stages, rest, ZERO)
    state[first + c.TOTAL] = totals[column_of(high, rung)]
    state[first + c.SAMPLE_SIZE] = size
    state[first + c.RESAMPLED] = wp.where(wanted, ONE, ZERO)
    state[first + c.DEGENERATE] = wp.where(wp.isinf(high), ONE, ZERO)
    state[first + c.RUNG] = part


@kernel
def add_scores(log_p, settings, score, largest, particles, block, sensor):
    """Add a sensor's log-likelihoods times its temperature to the scores."""
    b = wp.tid()
    begin = b * block
    if begin >= particles:
        return
    temperature = settings[c.TEMPERATURE + sensor]
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
    left = left_of(state, stage) * settings[c.DEPTH]
    scale = settings[c.SCALE]
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
        sums[b * c.WEIGHT_SUMS + k] = weights[k]
        sums[b * c.WEIGHT_SUMS + c.RUNGS + k] = squares[k]
    sums[b * c.WEIGHT_SUMS + 2 * c.RUNGS] = old
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
    scale = settings[c.SCALE]
    left = left_of(state, stage)
    high = possible_of(totals, highest[0])
    rung = int(0)
    if left > ZERO:
        rung = rung_of(totals, settings, settings[c.SHARE] * wp.float64(particles))
    if b == blocks:
        set_stage(totals, settings, state, high, left, rung, particles, stage, stages)
        return
    total = sum_before(sums, joined, b, fan, column_of(high, rung))
    low = left * settings[c.DEPTH]
    n = b * block
    end = wp.min(n + block, particles)
    while n < end:
        scores = eight_at(score, n, end, NEVER)
        prior = eight_at(before, n, end, ZERO)
        likelihood = tempered(scores, high, low)
        for _k in range(rung, c.RUNGS - 1):
            likelihood = wp.cw_mul(likelihood, likelihood)
        chosen = wp.cw_mul(prior, likelihood)
        for i in range(8):
            total += wp.floor(chosen[i] * scale)
            if n + i < end:
                write(weight, n + i, chosen[i])
                write(ends, n + i, total)
        n += 8
