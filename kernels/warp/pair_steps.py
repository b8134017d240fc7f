"""Noise and points of scans, from their readings; see gpusense/matching/points.py."""

import math

import warp as wp

from .reading_class import is_hit
from .sorting import sort_numbers
from .types import real, vec4

ZERO, ONE, MINUS_ONE = wp.float64(0.0), wp.float64(1.0), wp.float64(-1.0)
FOREVER = wp.float64(math.inf)
# Median absolute value of a normal error [standard deviations], and the deviation of rounding to steps of sqrt(12).
MEDIAN, ROOT_OF_12 = wp.float64(0.6745), wp.float64(3.4641016151377544)
# Neighbours whose ranges differ by more than this share do not belong to one surface.
LARGEST_STEP = wp.float64(0.35)
# Ranges come in steps if all differences are multiples of a step of at least this size [m], to within this share of it.
LEAST_STEP, LEAST_GAP = wp.float64(1e-3), wp.float64(0.5e-3)
ODD = wp.float64(0.02)
# Least beams for an estimate of noise.
LEAST_BEAMS = 12
# Points nearer than this have no bearing [m].
NEAREST = wp.float64(1e-6)


@wp.func
def deviation_of(before: wp.float64, here: wp.float64, after: wp.float64, left: wp.float64, right: wp.float64):
    """Return the difference between a range and its prediction from neighbours, in standard deviations."""
    expected = ONE / (left / before + right / after)
    limit = LARGEST_STEP * here
    deviation = wp.float64(FOREVER)
    if expected > ZERO and wp.abs(before - here) < limit and wp.abs(after - here) < limit:
        one = expected / before
        other = expected / after
        from_left = one * one * left
        from_right = other * other * right
        deviation = wp.abs(here - expected) / wp.sqrt(ONE + from_left * from_left + from_right * from_right)
    return deviation


@wp.func
def rounding_of(number: wp.array(dtype=wp.float64), first: wp.int32, count: wp.int32, deviation: wp.float64):
    """Return the deviation of rounding to the steps of ascending ranges, 0 without steps or below another one."""
    step = wp.float64(FOREVER)
    gaps = int(0)
    for i in range(1, count):
        gap = number[first + i] - number[first + i - 1]
        if gap > LEAST_GAP:
            step = wp.min(gap, step)
            gaps += 1
    rounding = step / ROOT_OF_12
    if gaps < LEAST_BEAMS or not (step > LEAST_STEP and rounding > deviation):
        return ZERO
    for i in range(1, count):
        gap = number[first + i] - number[first + i - 1]
        multiple = gap / step
        if gap > LEAST_GAP and wp.abs(multiple - wp.rint(multiple)) > ODD:
            rounding = ZERO
    return rounding


@wp.func
def noise_of(
    reading: wp.array(dtype=wp.float64), first: wp.int32, weight: wp.array(dtype=wp.float64), places: wp.int32,
    padded: wp.int32, step: wp.int32, nearest: wp.float64, farthest: wp.float64, work: wp.array(dtype=wp.float64),
):  # fmt: skip
    """Return the standard deviation of a scan's ranges, -1 where too few beams measure it."""
    number = int(0)
    for i in range(padded):
        work[i] = FOREVER
        work[padded + i] = FOREVER
        if i < places:
            before = reading[first + step * i]
            here = reading[first + step * i + 1]
            after = reading[first + step * i + 2]
            used = is_hit(before, nearest, farthest) and is_hit(here, nearest, farthest)
            if used and is_hit(after, nearest, farthest):
                deviation = deviation_of(before, here, after, weight[2 * i], weight[2 * i + 1])
                if deviation < FOREVER:
                    work[i] = deviation
                    work[padded + i] = here
                    number += 1
    if number < LEAST_BEAMS:
        return MINUS_ONE
    sort_numbers(work, 0, padded, 2 * padded)
    sort_numbers(work, padded, padded, 3 * padded)
    deviation = work[2 * padded + (number - 1) // 2] / MEDIAN
    return wp.max(rounding_of(work, 3 * padded, number, deviation), deviation)


@wp.func
def level_of(noise: wp.float64, level: wp.array(dtype=wp.float64), levels: wp.int32, assumed: wp.int32):
    """Return the level of noise of a pair."""
    number = int(0)
    while number < levels - 1 and noise > level[2 * number]:
        number += 1
    if noise < ZERO:
        number = assumed
    return number


@wp.func
def place_points(
    reading: wp.array(dtype=wp.float64), first: wp.int32, beam: wp.array(dtype=wp.float64), beams: wp.int32,
    nearest: wp.float64, farthest: wp.float64, point: wp.array(dtype=vec4), to: wp.int32,
):  # fmt: skip
    """Write the points of a scan's hits from to on, and return their number and the sum of squared ranges."""
    count = int(0)
    squares = wp.float64(0.0)
    for i in range(beams):
        z = reading[first + wp.int32(beam[4 * i + 3])]
        if is_hit(z, nearest, farthest) and z > NEAREST:
            point[to + count] = vec4(real(z * beam[4 * i]), real(z * beam[4 * i + 1]), real(beam[4 * i + 2]), real(z))
            squares += z * z
            count += 1
    return count, squares
