"""The ladder of temperatures of a correction, and the state of its stages: b_k = b / 2^k, where b is what is left.

See weighing.py.
"""

import warp as wp

from .elementary import exp_of

SHARE, THRESHOLD, SCALE = (wp.constant(place) for place in (19, 20, 21))
RUNGS, WEIGHT_SUMS = wp.constant(8), wp.constant(17)
# Places in the state: of a stage, and of what lasts.
LEFT, TOTAL, SAMPLE_SIZE, RESAMPLED, DEGENERATE, RUNG = (wp.constant(place) for place in range(6))
STAGE, INJECTED = wp.constant(8), wp.constant(51)
ZERO, HALF, ONE = wp.constant(wp.float64(0.0)), wp.constant(wp.float64(0.5)), wp.constant(wp.float64(1.0))


# Return the largest score of all blocks.
@wp.func
def largest_of(largest: wp.array(dtype=wp.float64), blocks: wp.int32):
    high = largest[0]
    for b in range(1, blocks):
        high = wp.max(high, largest[b])
    return high


# Return the likelihood of a score relative to the largest; 1 where none is possible or nothing is left.
@wp.func
def tempered(score: wp.float64, largest: wp.float64, left: wp.float64):
    value = ONE
    if not wp.isinf(largest) and left > ZERO:
        value = exp_of(left * (score - largest))
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


# Write the state of a stage that uses a rung.
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
    state[first + TOTAL] = totals[rung]
    state[first + SAMPLE_SIZE] = size
    state[first + RESAMPLED] = wp.where(wanted, ONE, ZERO)
    state[first + DEGENERATE] = wp.where(wp.isinf(high), ONE, ZERO)
    state[first + RUNG] = part
