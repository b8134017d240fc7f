"""Readings that are on the device: which of them count and where they go, as gpusense/scan.py finds it on the host.

Readings that say nothing are left out and the others move up, so that sums over blocks of them have the same bits; what
is left at the end are missing readings (nan), which add nothing.
"""

import functools
import math

import warp as wp

from .error_free import BLOCK_TERMS
from .prelude import kernel, precision

# What max readings are: left out, in the constant, or evaluated like others.
MAX_LEFT_OUT, MAX_FIXED, MAX_PLACED = wp.constant(0), wp.constant(1), wp.constant(2)
ZERO = wp.constant(wp.float64(0.0))
MISSING, FAR = wp.constant(wp.float64(math.nan)), wp.constant(wp.float64(math.inf))


# Whether an even choice of so many informative readings has that of a rank: some i * informative / chosen is it.
@wp.func
def is_chosen(rank: wp.int32, informative: wp.int32, chosen: wp.int32):
    if chosen >= informative:
        return True
    if chosen == 0:
        return False
    all_of_them = wp.int64(informative)
    some = wp.int64(chosen)
    nearest = (wp.int64(rank) * some + all_of_them - wp.int64(1)) // all_of_them
    return nearest * all_of_them // some == wp.int64(rank)


@functools.cache
def make(name, flags):
    """A kernel of this file specialised by the flags."""
    types = precision(flags)
    real, vec2 = types.real, types.vec2
    coordinate = wp.float32 if "RANGES_FLOAT32" in flags else wp.float64
    block_terms = wp.types.vector(length=BLOCK_TERMS, dtype=wp.float64)
    ALL_READINGS = "ALL_READINGS" in flags
    END_POINTS = "END_POINTS" in flags
    NOTHING, NEVER = real(0.0), real(-math.inf)
    NO_READING, AHEAD = real(math.nan), vec2(1.0, 0.0)

    # One work-item a beam and place: it looks at all readings, of which 16 are read before any is looked at, finds the
    # place of its own and fills it. A place gets its reading, at most top, and as points the vectors of its beam, each
    # of them; with END_POINTS a point is the reading times its vector, in cells, and what rounding took from it. A max
    # reading is inf. The guard is guard_scale (longest + 2 cells) of a block of places. Fixed is what max readings add
    # that have no place; -inf where a range is there and none is possible.
    @kernel
    def place_readings(
        ranges: wp.array(dtype=coordinate),
        beam: wp.array(dtype=wp.int32),
        vector: wp.array(dtype=wp.float64),
        point: wp.array(dtype=vec2),
        point_low: wp.array(dtype=vec2),
        reading: wp.array(dtype=real),
        guard: wp.array(dtype=real),
        fixed: wp.array(dtype=real),
        beams: wp.int32,
        each: wp.int32,
        places: wp.int32,
        chosen: wp.int32,
        max_readings: wp.int32,
        possible: wp.int32,
        nearest: wp.float64,
        farthest: wp.float64,
        log_max: wp.float64,
        resolution: wp.float64,
        top: wp.float64,
        guard_scale: wp.float64,
    ):
        own = wp.tid()
        if own >= wp.max(wp.max(beams, places), 1):
            return
        informative = beams
        if chosen < beams:
            informative = int(0)
            for k in range(beams):
                z = wp.float64(ranges[beam[k]])
                if z >= nearest and (z < farthest or max_readings != MAX_LEFT_OUT):
                    informative += 1
        rank = int(0)
        place = int(0)
        own_place = int(places)
        far_count = int(0)
        impossible = bool(False)
        own_value = wp.float64(MISSING)
        # Of the readings in the block of places that begins with the own one, if one does.
        longest = wp.float64(0.0)
        first = int(0)
        while first < beams:
            several = block_terms()
            for i in range(BLOCK_TERMS):
                several[i] = MISSING
                if first + i < beams:
                    several[i] = wp.float64(ranges[beam[first + i]])
            for i in range(BLOCK_TERMS):
                k = first + i
                z = several[i]
                hit = z >= nearest and z < farthest
                far = z >= farthest
                told = hit or (far and max_readings != MAX_LEFT_OUT)
                used = told and is_chosen(rank, informative, chosen)
                as_range = used and hit and possible != 0
                as_far = used and far and max_readings == MAX_PLACED
                rank += int(told)
                far_count += int(used and far)
                if used and hit and possible == 0:
                    impossible = True
                placed = as_range or as_far
                if ALL_READINGS:
                    placed = k < beams
                if placed and k == own:
                    own_place = place
                    own_value = wp.where(as_range, z, wp.where(as_far, FAR, MISSING))
                if as_range and place >= own_place and place < own_place + BLOCK_TERMS:
                    longest = wp.max(longest, z)
                place += int(placed)
            first += BLOCK_TERMS
        left_over = own >= place and own < places
        if END_POINTS:
            if own_place < places:
                cells = own_value / resolution
                length = wp.where(wp.isfinite(cells), cells, ZERO)
                x = vector[2 * own * each] * length
                y = vector[2 * own * each + 1] * length
                high = vec2(real(x), real(y))
                point_low[own_place] = vec2(real(x - wp.float64(high.x)), real(y - wp.float64(high.y)))
                if not wp.isfinite(cells):
                    high = vec2(real(cells), real(cells))
                point[own_place] = high
                if own_place % BLOCK_TERMS == 0:
                    guard[own_place // BLOCK_TERMS] = real(guard_scale * (longest / resolution + wp.float64(2.0)))
            if left_over:
                point[own] = vec2(NO_READING, NO_READING)
                point_low[own] = vec2(NOTHING, NOTHING)
                if own % BLOCK_TERMS == 0:
                    guard[own // BLOCK_TERMS] = real(guard_scale * wp.float64(2.0))
        else:
            if own_place < places:
                for j in range(each):
                    source = 2 * (own * each + j)
                    point[own_place * each + j] = vec2(real(vector[source]), real(vector[source + 1]))
                rounded = real(own_value)
                if rounded > real(top) and not wp.isinf(rounded):
                    rounded = real(top)
                reading[own_place] = rounded
            if left_over:
                for j in range(each):
                    point[own * each + j] = AHEAD
                reading[own] = NO_READING
        if own == 0:
            constant = NOTHING
            if max_readings == MAX_FIXED:
                constant = real(wp.float64(far_count) * log_max)
            if impossible:
                constant = NEVER
            fixed[0] = constant

    return {"place_readings": place_readings}[name]
