"""Likelihood field of a whole scan (book table 6.3): one look-up at each beam's end point.

A ring of two cells around the table represents everything outside the grid, so no look-up needs a bounds test. It has
fewer than 2^31 cells, and a launch fewer than 2^31 parts, so indices fit int32.
"""

import warp as wp

from gpusense.interface.constants import BLOCK_TERMS

from .end_point import end_point, field_cell, rounded_cell, rounding_margin, table_cell, table_origin
from .error_free import add_term
from .field_term import careful_value, quick_value, reading_value
from .flags import CUBES, IN_LANES, PER_BEAM, ROUNDED_CELLS, SCANS, TWO_PART_POINTS, WORLDS
from .lanes.field_term import block_exponents, block_logs
from .prelude import behind, field_readers, kernel, reader, work_item
from .shapes import world_begin, world_window
from .types import FieldTerms, Window, real, vec2, vec4

# Particles per work-group of field_blocks.
GROUP = 64
rest_of = behind(real)
ZERO, HALF = real(0.0), real(0.5)
# A constant of a loop that Warp shall unroll.
HALF_BLOCK = BLOCK_TERMS // 2
number_at, cell_at, point_at, pose_at = reader(real), reader(wp.vec2i), reader(vec2), reader(vec4)
two_at, term_of = reader(vec2, 2), field_readers(FieldTerms)
block_cells = wp.types.vector(length=BLOCK_TERMS, dtype=wp.int32)


@wp.func
def rounded_block(
    table: wp.array(dtype=real), origin: wp.vec2i, sensor_pose: vec4, sensor_low: vec4, point: wp.array(dtype=vec2),
    point_low: wp.array(dtype=vec2), begin: wp.int32, end: wp.int32, far: real, window: Window, guard: real,
):  # fmt: skip
    """Return the sum of the readings from begin to end by rounded cells, with more digits near edges of cells."""
    lowered = sensor_pose - vec4(HALF, HALF, ZERO, ZERO)
    start_cell = table_origin(origin, window.cols)
    sure = rounding_margin(guard)
    total = real(0.0)
    worst = real(0.0)
    if begin + BLOCK_TERMS <= end:
        if SCANS:
            for i in range(BLOCK_TERMS):
                value, off = quick_value(table, start_cell, lowered, point_at(point, begin + i), far, window)
                worst = wp.max(worst, off)
                total += value
        else:
            # The points of one scan are aligned, so that two of them can be read at once.
            for i in range(HALF_BLOCK):
                pair = two_at(point, begin + 2 * i)
                value, off = quick_value(table, start_cell, lowered, vec2(pair.x, pair.y), far, window)
                worst = wp.max(worst, off)
                total += value
                value, off = quick_value(table, start_cell, lowered, vec2(pair.z, pair.w), far, window)
                worst = wp.max(worst, off)
                total += value
    else:
        k = int(begin)
        while k < end:
            value, off = quick_value(table, start_cell, lowered, point_at(point, k), far, window)
            worst = wp.max(worst, off)
            total += value
            k += 1
    if worst > sure:
        total = ZERO
        k = int(begin)
        while k < end:
            to, to_low = point_at(point, k), point_at(point_low, k)
            total += careful_value(
                table, origin, lowered, sensor_pose, sensor_low, to, to_low, far, window, guard, sure
            )
            k += 1
    return total


@wp.func
def field_log(total: vec2, temperature: real):
    """Return log p of a scan from its sum of two parts."""
    if CUBES:
        return temperature * wp.log(total.x + total.y)
    else:
        if wp.isinf(total.x):
            return total.x
        return temperature * (total.x + total.y)


@wp.func
def staged_sum(
    table: wp.array(dtype=real), origin: wp.vec2i, sensor_pose: vec4, sensor_low: vec4, point: wp.array(dtype=vec2),
    point_low: wp.array(dtype=vec2), terms: wp.array(dtype=FieldTerms), parts: wp.array(dtype=real), window: Window,
    begin: wp.int32, size: wp.int32, first_part: wp.int32, before: vec2,
):  # fmt: skip
    """Return the sum of the readings from begin on, in two parts, with that of total. Places, distances, exponents and
    densities of a block are computed each in a loop: on processors the first and the third become vector code.
    """
    total = before
    filled = wp.min(size, BLOCK_TERMS)
    k = int(0)
    while k < size:
        # The last block begins with readings of the one before it, so that all have as many.
        lead = k - wp.min(k, size - filled)
        exponent, exponent_low = block_exponents(
            table, origin, sensor_pose, sensor_low, point, point_low, terms, window, begin + k - lead, filled
        )
        values = block_logs(exponent, exponent_low, terms)
        block = ZERO
        i = int(lead)
        while i < filled:
            term = values[i]
            if PER_BEAM:
                parts[first_part + k + i - lead] = term
            block += term
            i += 1
        total = add_term(total, block)
        k += BLOCK_TERMS
    return total


@kernel
def score_field(
    table, world, shapes, pose_cell, pose, pose_low, point, point_low, terms, start, constant_terms, log_p, parts,
    window, particles, readings, guard, score, batch, crowd,
):  # fmt: skip
    """Score scans: one work-item takes a particle."""
    n = wp.tid()
    if n >= particles:
        return
    field = table
    seen = window
    if WORLDS:
        field = rest_of(table, world_begin(world, n, 1))
        seen = world_window(world, n)
    origin = pose_cell[n]
    sensor_pose = pose[n]
    sensor_low = vec4()
    if TWO_PART_POINTS:
        sensor_low = pose_low[n]
    begin = int(0)
    size = readings
    constant_term = score.constant_term
    if SCANS:
        scan = (n + batch.ahead) // batch.per_scan
        begin = start[scan]
        size = start[scan + 1] - begin
        constant_term = constant_terms[scan]
    total = vec2(constant_term, ZERO)
    block = real(0.0)
    # While loops show the compiler that indices are not negative; range would cost a tenth on processors.
    k = int(0)
    if ROUNDED_CELLS:
        # First all cells of a block, then all look-ups. On processors the first loop becomes vector code and takes
        # a third of the time. It would not in a function, with points read as vec2, or a maximum in place of a
        # count.
        lowered = sensor_pose - vec4(HALF, HALF, ZERO, ZERO)
        start_cell = table_origin(origin, seen.cols)
        sure = rounding_margin(guard)
        cells = block_cells()
        while k < size:
            first = begin + k
            width = wp.min(size - k, BLOCK_TERMS)
            doubtful = int(0)
            i = int(0)
            while i < width:
                near, off = rounded_cell(lowered, point_at(point, first + i))
                doubtful += int(off > sure)
                cells[i] = table_cell(near, start_cell, seen)
                i += 1
            if doubtful > 0:
                i = int(0)
                while i < width:
                    exact = end_point(sensor_pose, sensor_low, point[first + i], point_low[first + i], ZERO, guard)
                    cells[i] = field_cell(origin.x + exact.cell.x, origin.y + exact.cell.y, seen)
                    i += 1
            block = ZERO
            i = int(0)
            while i < width:
                term = field[cells[i]]
                if PER_BEAM:
                    parts[n * readings + k + i] = term
                block += term
                i += 1
            total = add_term(total, block)
            k += width
    elif IN_LANES:
        total = staged_sum(
            field, origin, sensor_pose, sensor_low, point, point_low, terms, parts, seen, begin, size,
            n * readings, total,
        )  # fmt: skip
    else:
        while k < size:
            to = point[begin + k]
            to_low = vec2()
            if TWO_PART_POINTS:
                to_low = point_low[begin + k]
            term = reading_value(
                field, origin, sensor_pose, sensor_low, to, to_low, terms, seen, guard, shapes, world, crowd, n
            )
            if PER_BEAM:
                parts[n * readings + k] = term
            block += term
            k += 1
            if k % BLOCK_TERMS == 0:
                total = add_term(total, block)
                block = ZERO
        total = add_term(total, block)
    log_p[n] = field_log(total, score.temperature)


@kernel
def field_blocks(
    table, world, shapes, pose_cell, pose, pose_low, point, point_low, terms, guard, start, parts, window,
    particles, readings, spread, batch, crowd,
):  # fmt: skip
    """Write the sums of blocks of readings to parts[n + block * particles], for GPUs."""
    item = work_item(wp.tid())
    n = ((item // GROUP) >> spread) * GROUP + item % GROUP
    if n >= particles:
        return
    field = table
    seen = window
    if WORLDS:
        field = rest_of(table, world_begin(world, n, 1))
        seen = world_window(world, n)
    origin = cell_at(pose_cell, n)
    sensor_pose = pose_at(pose, n)
    sensor_low = vec4()
    if TWO_PART_POINTS:
        sensor_low = pose_at(pose_low, n)
    before = int(0)
    size = readings
    guards = int(0)
    if SCANS:
        scan = n // batch.per_scan
        before = start[scan]
        size = start[scan + 1] - before
        guards = scan * ((readings + BLOCK_TERMS - 1) // BLOCK_TERMS)
    block = (item // GROUP) & ((1 << spread) - 1)
    while block * BLOCK_TERMS < size:
        begin = before + block * BLOCK_TERMS
        end = wp.min(begin + BLOCK_TERMS, before + size)
        total = real(0.0)
        block_guard = number_at(guard, guards + block)
        if ROUNDED_CELLS:
            total = rounded_block(
                field, origin, sensor_pose, sensor_low, point, point_low, begin, end, term_of.z_max(terms), seen,
                block_guard,
            )  # fmt: skip
        else:
            k = begin
            while k < end:
                to_low = vec2()
                if TWO_PART_POINTS:
                    to_low = point_at(point_low, k)
                to = point_at(point, k)
                total += reading_value(
                    field, origin, sensor_pose, sensor_low, to, to_low, terms, seen, block_guard, shapes, world,
                    crowd, n,
                )  # fmt: skip
                k += 1
        parts[n + block * particles] = total
        block += 1 << spread
