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

    # One work-item a block of places: it looks at all readings, of which 16 are read before any is looked at. A place
    # gets its reading, at most top, and as points the vectors of its beam, each of them; with END_POINTS a point is the
    # reading times its vector, in cells, and what rounding took from it. A max reading is inf. The guard is guard_scale
    # (longest + 2 cells) of a block. Fixed is what max readings add that have no place; -inf where a range is there and
    # none is possible.
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
        block = wp.tid()
        begin = block * BLOCK_TERMS
        end = wp.min(begin + BLOCK_TERMS, places)
        if block > 0 and begin >= places:
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
        far_count = int(0)
        impossible = bool(False)
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
                if told:
                    rank += 1
                value = MISSING
                if used:
                    if hit:
                        if possible != 0:
                            value = z
                        else:
                            impossible = True
                    else:
                        far_count += 1
                        if max_readings == MAX_PLACED:
                            value = FAR
                placed = not wp.isnan(value)
                if ALL_READINGS:
                    placed = k < beams
                if placed:
                    if place >= begin and place < end:
                        if END_POINTS:
                            cells = value / resolution
                            length = wp.where(wp.isfinite(cells), cells, ZERO)
                            x = vector[2 * k * each] * length
                            y = vector[2 * k * each + 1] * length
                            high = vec2(real(x), real(y))
                            point_low[place] = vec2(real(x - wp.float64(high.x)), real(y - wp.float64(high.y)))
                            if not wp.isfinite(cells):
                                high = vec2(real(cells), real(cells))
                            point[place] = high
                            longest = wp.max(longest, length)
                        else:
                            for j in range(each):
                                source = 2 * (k * each + j)
                                point[place * each + j] = vec2(real(vector[source]), real(vector[source + 1]))
                            rounded = real(value)
                            if rounded > real(top) and not wp.isinf(rounded):
                                rounded = real(top)
                            reading[place] = rounded
                    place += 1
            first += BLOCK_TERMS
        rest = wp.max(place, begin)
        while rest < end:
            if END_POINTS:
                point[rest] = vec2(NO_READING, NO_READING)
                point_low[rest] = vec2(NOTHING, NOTHING)
            else:
                for j in range(each):
                    point[rest * each + j] = AHEAD
                reading[rest] = NO_READING
            rest += 1
        if END_POINTS:
            if begin < places:
                guard[block] = real(guard_scale * (longest + wp.float64(2.0)))
        if block == 0:
            constant = NOTHING
            if max_readings == MAX_FIXED:
                constant = real(wp.float64(far_count) * log_max)
            if impossible:
                constant = NEVER
            fixed[0] = constant

    return {"place_readings": place_readings}[name]
