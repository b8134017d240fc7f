"""Placement of poses and readings in the device's memory."""

import math

import warp as wp

from gpusense.interface.constants import BLOCK_TERMS, MAX_FIXED, MAX_LEFT_OUT, MAX_PLACED

from .flags import ALL_READINGS, END_POINTS, SOME_BEAMS
from .placement import place_pose
from .prelude import kernel, popcount, work_item
from .reading_class import is_hit, is_max
from .types import ReadingRules, measured, real, vec2

ZERO = wp.float64(0.0)
MISSING, FAR = wp.float64(math.nan), wp.float64(math.inf)


@wp.func
def is_chosen(rank: wp.int32, informative: wp.int32, chosen: wp.int32):
    """Return whether an even choice of informative readings includes this rank."""
    if chosen >= informative:
        return True
    if chosen == 0:
        return False
    all_of_them = wp.int64(informative)
    some = wp.int64(chosen)
    nearest = (wp.int64(rank) * some + all_of_them - wp.int64(1)) // all_of_them
    return nearest * all_of_them // some == wp.int64(rank)


block_terms = wp.types.vector(length=BLOCK_TERMS, dtype=wp.float64)
NOTHING, NEVER = real(0.0), real(-math.inf)
NO_READING, AHEAD = real(math.nan), vec2(1.0, 0.0)


@wp.func
def reading_of(k: wp.int32, ranges: wp.array(dtype=measured), beam: wp.array(dtype=wp.int32), beams: wp.int32):
    """Return reading k of the chosen beams, nan beyond the last."""
    z = wp.float64(MISSING)
    if k < beams:
        if SOME_BEAMS:
            z = wp.float64(ranges[beam[k]])
        else:
            z = wp.float64(ranges[k])
    return z


@wp.func
def count_informative(ranges: wp.array(dtype=measured), beam: wp.array(dtype=wp.int32), rules: ReadingRules):
    """Return the number of informative readings; not counted where all are chosen."""
    informative = int(rules.beams)
    if rules.chosen < rules.beams:
        informative = int(0)
        for k in range(rules.beams):
            z = reading_of(k, ranges, beam, rules.beams)
            far = rules.max_readings != MAX_LEFT_OUT and is_max(z, rules.farthest)
            if is_hit(z, rules.nearest, rules.farthest) or far:
                informative += 1
    return informative


@wp.func
def read_block(first: wp.int32, ranges: wp.array(dtype=measured), beam: wp.array(dtype=wp.int32), rules: ReadingRules):
    """Read the 16 readings from first on."""
    several = block_terms()
    for i in range(BLOCK_TERMS):
        several[i] = reading_of(first + i, ranges, beam, rules.beams)
    hits = int(0)
    fars = int(0)
    for i in range(BLOCK_TERMS):
        hits = hits | (int(is_hit(several[i], rules.nearest, rules.farthest)) << i)
        fars = fars | (int(is_max(several[i], rules.farthest)) << i)
    return several, hits, fars


@wp.func
def chosen_of(telling: wp.int32, rank: wp.int32, informative: wp.int32, chosen: wp.int32):
    """Return the set of a block's informative readings that are chosen; rank belongs to the first reading."""
    used = int(telling)
    if chosen < informative:
        for i in range(BLOCK_TERMS):
            rank_of_i = rank + popcount(telling & ((1 << i) - 1))
            if not is_chosen(rank_of_i, informative, chosen):
                used = used & ~(1 << i)
    return used


@wp.func
def placed_of(used: wp.int32, hits: wp.int32, fars: wp.int32, left: wp.int32, rules: ReadingRules):
    """Return the sets of a block's chosen readings that get a place, as ranges, as max readings, and all."""
    as_range = int(0)
    if rules.possible != 0:
        as_range = used & hits
    as_far = int(0)
    if rules.max_readings == MAX_PLACED:
        as_far = used & fars
    placed = as_range | as_far
    if ALL_READINGS:
        placed = (1 << wp.min(left, BLOCK_TERMS)) - 1
    return as_range, as_far, placed


@wp.func
def longest_beside(several: block_terms, as_range: wp.int32, placed: wp.int32, place: wp.int32, begin: wp.int32):
    """Return a block's longest range among readings placed in the block of places from begin on."""
    longest = wp.float64(0.0)
    for i in range(BLOCK_TERMS):
        other = place + popcount(placed & ((1 << i) - 1))
        beside = other >= begin and other < begin + BLOCK_TERMS
        if (as_range >> i) & 1 != 0 and beside:
            longest = wp.max(longest, several[i])
    return longest


@wp.func
def fill_end_point(
    place: wp.int32, value: wp.float64, vector: wp.vec2d, longest: wp.float64, point: wp.array(dtype=vec2),
    point_low: wp.array(dtype=vec2), guard: wp.array(dtype=real), resolution: wp.float64, guard_scale: wp.float64,
):  # fmt: skip
    """Fill a place with the end point of a reading."""
    cells = value / resolution
    length = wp.where(wp.isfinite(cells), cells, ZERO)
    x = vector.x * length
    y = vector.y * length
    high = vec2(real(x), real(y))
    point_low[place] = vec2(real(x - wp.float64(high.x)), real(y - wp.float64(high.y)))
    if not wp.isfinite(cells):
        high = vec2(real(cells), real(cells))
    point[place] = high
    if place % BLOCK_TERMS == 0:
        guard[place // BLOCK_TERMS] = real(guard_scale * (longest / resolution + wp.float64(2.0)))


@wp.func
def fill_rays(
    place: wp.int32, value: wp.float64, vector: wp.vec2d, vectors: wp.array(dtype=wp.float64), source: wp.int32,
    point: wp.array(dtype=vec2), reading: wp.array(dtype=real), each: wp.int32, top: wp.float64,
):  # fmt: skip
    """Fill a place with a reading, at most top, and with the vectors of its beam."""
    point[place * each] = vec2(real(vector.x), real(vector.y))
    for j in range(1, each):
        point[place * each + j] = vec2(real(vectors[source + 2 * j]), real(vectors[source + 2 * j + 1]))
    rounded = real(value)
    if rounded > real(top) and not wp.isinf(rounded):
        rounded = real(top)
    reading[place] = rounded


@wp.func
def fill_item(
    item: wp.int32, item_place: wp.int32, left_over: wp.bool, value: wp.float64, vector_of_item: wp.vec2d,
    longest: wp.float64, vectors: wp.array(dtype=wp.float64), point: wp.array(dtype=vec2),
    point_low: wp.array(dtype=vec2), reading: wp.array(dtype=real), guard: wp.array(dtype=real),
    resolution: wp.float64, rules: ReadingRules,
):  # fmt: skip
    """Fill the place of an item's reading, if it has one, or with left_over that of a missing reading."""
    if END_POINTS:
        scale = rules.guard_scale
        if item_place < rules.places:
            fill_end_point(item_place, value, vector_of_item, longest, point, point_low, guard, resolution, scale)
        if left_over:
            ahead = wp.vec2d(wp.float64(1.0), wp.float64(0.0))
            fill_end_point(item, wp.float64(MISSING), ahead, ZERO, point, point_low, guard, resolution, scale)
    else:
        each = rules.rays_per_beam
        if item_place < rules.places:
            source = 2 * item * each
            fill_rays(item_place, value, vector_of_item, vectors, source, point, reading, each, rules.top)
        if left_over:
            for j in range(each):
                point[item * each + j] = AHEAD
            reading[item] = NO_READING


@wp.func
def place_reading(
    item: wp.int32, ranges: wp.array(dtype=measured), beam: wp.array(dtype=wp.int32),
    vector: wp.array(dtype=wp.float64), point: wp.array(dtype=vec2), point_low: wp.array(dtype=vec2),
    reading: wp.array(dtype=real), guard: wp.array(dtype=real), constant_term: wp.array(dtype=real),
    resolution: wp.float64, rules: ReadingRules,
):  # fmt: skip
    """Place one reading: find its place from all readings, and fill that place."""
    # Values that are needed last are read first, so that nothing waits for them.
    source = 2 * item * rules.rays_per_beam
    item_reading = reading_of(item, ranges, beam, rules.beams)
    vector_of_item = wp.vec2d(wp.float64(1.0), wp.float64(0.0))
    if item < rules.beams:
        vector_of_item = wp.vec2d(vector[source], vector[source + 1])
    informative = count_informative(ranges, beam, rules)
    rank = int(0)
    place = int(0)
    item_place = int(rules.places)
    far_count = int(0)
    impossible = bool(False)
    item_value = wp.float64(MISSING)
    # The longest reading in the block of places that begins with this item's place, if a block begins there.
    longest = wp.float64(0.0)
    first = int(0)
    while first < rules.beams:
        several, hits, fars = read_block(first, ranges, beam, rules)
        telling = int(hits)
        if rules.max_readings != MAX_LEFT_OUT:
            telling = hits | fars
        used = chosen_of(telling, rank, informative, rules.chosen)
        as_range, as_far, placed = placed_of(used, hits, fars, rules.beams - first, rules)
        item_bit = item - first
        if item_bit >= 0 and item_bit < BLOCK_TERMS:
            if (placed >> item_bit) & 1 != 0:
                item_place = place + popcount(placed & ((1 << item_bit) - 1))
                if (as_range >> item_bit) & 1 != 0:
                    item_value = item_reading
                if (as_far >> item_bit) & 1 != 0:
                    item_value = wp.float64(FAR)
        if END_POINTS:
            begins = item_place < rules.places and item_place % BLOCK_TERMS == 0
            if begins and place < item_place + BLOCK_TERMS:
                longest = wp.max(longest, longest_beside(several, as_range, placed, place, item_place))
        rank += popcount(telling)
        far_count += popcount(used & fars)
        if rules.possible == 0 and (used & hits) != 0:
            impossible = True
        place += popcount(placed)
        first += BLOCK_TERMS
    left_over = item >= place and item < rules.places
    fill_item(
        item, item_place, left_over, item_value, vector_of_item, longest, vector, point, point_low, reading, guard,
        resolution, rules,
    )  # fmt: skip
    if item == 0:
        constant = NOTHING
        if rules.max_readings == MAX_FIXED:
            constant = real(wp.float64(far_count) * rules.log_max)
        if impossible:
            constant = NEVER
        constant_term[0] = constant


@kernel
def place_inputs(
    poses, pose_cell, pose, pose_low, pose_status, ranges, beam, vector, point, point_low, reading, guard,
    constant_term, frame, window, particles, head, rules,
):  # fmt: skip
    """Place readings and poses: one work-item takes a beam and place, in whole groups."""
    item = work_item(wp.tid())
    particle = item - head
    if particle >= 0 and particle < particles:
        place_pose(particle, poses, pose_cell, pose, pose_low, pose_status, frame, window)  # fmt: skip
    if item < head and item < wp.max(wp.max(rules.beams, rules.places), 1):
        place_reading(
            item, ranges, beam, vector, point, point_low, reading, guard, constant_term, frame.resolution, rules
        )


@wp.func
def placed_value(
    k: wp.int32, before: wp.int32, ranges: wp.array(dtype=measured), beam: wp.array(dtype=wp.int32),
    rules: ReadingRules,
):  # fmt: skip
    """Return reading k of a scan as a range, infinity for a max reading that counts, else nan."""
    z = wp.float64(ranges[before + beam[k]])
    value = wp.float64(MISSING)
    if is_hit(z, rules.nearest, rules.farthest):
        value = z
    elif rules.max_readings != MAX_LEFT_OUT and is_max(z, rules.farthest):
        value = wp.float64(FAR)
    return value


@kernel
def place_scans(
    ranges, beam, vector, point, point_low, reading, guard, scans, head, blocks, resolution, rules
):  # fmt: skip
    """Place the readings of scans of one particle each, all of them. One work-item takes a reading."""
    item = work_item(wp.tid())
    scan = item // rules.beams
    if scan >= scans:
        return
    k = item % rules.beams
    value = placed_value(k, scan * head, ranges, beam, rules)
    source = 2 * k * rules.rays_per_beam
    first = wp.vec2d(vector[source], vector[source + 1])
    if END_POINTS:
        cells = value / resolution
        length = ZERO
        if wp.isfinite(cells):
            length = cells
        high = vec2(real(first.x * length), real(first.y * length))
        point_low[item] = vec2(real(first.x * length - wp.float64(high.x)), real(first.y * length - wp.float64(high.y)))
        if not wp.isfinite(cells):
            high = vec2(real(cells), real(cells))
        point[item] = high
        if k % BLOCK_TERMS == 0:
            longest = wp.float64(0.0)
            for i in range(k, wp.min(k + BLOCK_TERMS, rules.beams)):
                other = placed_value(i, scan * head, ranges, beam, rules)
                if wp.isfinite(other):
                    longest = wp.max(longest, other)
            guard[scan * blocks + k // BLOCK_TERMS] = real(rules.guard_scale * (longest / resolution + wp.float64(2.0)))
    else:
        fill_rays(item, value, first, vector, source, point, reading, rules.rays_per_beam, rules.top)
