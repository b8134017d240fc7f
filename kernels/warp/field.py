"""Likelihood field of a whole scan (book table 6.3): one look-up at each beam's end point.

The table is padded by a ring of two cells for everything outside the grid, so no look-up needs a bounds test. It has
fewer than 2^31 cells, and a launch fewer than 2^31 parts, so indices fit int32.
"""

import functools
from types import SimpleNamespace

import warp as wp

from . import end_point as end_points
from . import error_free
from .end_point import field_cell
from .error_free import BLOCK_TERMS
from .prelude import kernel, precision, reader, work_item

# Particles per work-group of field_blocks.
GROUP = wp.constant(64)


@functools.cache
def functions(flags):
    """Make the functions of the file for a set of flags."""
    types = precision(flags)
    real, vec2, vec4 = types.real, types.vec2, types.vec4
    exact = error_free.functions(flags)
    pair_sum, pair_product = exact.pair_sum, exact.pair_product
    ends = end_points.functions(flags)
    EndPoint, end_point = ends.EndPoint, ends.end_point
    number_at = reader(real)
    ALL_READINGS = "ALL_READINGS" in flags
    BILINEAR = "BILINEAR" in flags
    HIT = "HIT" in flags
    LINEAR = "LINEAR" in flags
    LOG_TABLE = "LOG_TABLE" in flags
    SHARP = "SHARP" in flags
    ZERO, ONE = real(0.0), real(1.0)
    SHIFT = real(0.5 if BILINEAR else 0.0)

    # Return the weighted sum of a and b, all of two parts. No term is negative, so small values keep their digits.
    @wp.func
    def between(weight_a: vec2, a: vec2, weight_b: vec2, b: vec2):
        if SHARP:
            return pair_sum(pair_product(weight_a, a), pair_product(weight_b, b))
        else:
            return vec2(weight_a.x * a.x + weight_b.x * b.x, ZERO)

    # Interpolate the distance between the four cell centres around an end point, in two parts.
    @wp.func
    def bilinear(table: wp.array(dtype=real), cell: wp.vec2i, end: EndPoint, window: types.Window):
        a = vec2(number_at(table, field_cell(cell.x, cell.y, window)), ZERO)
        b = vec2(number_at(table, field_cell(cell.x + 1, cell.y, window)), ZERO)
        c = vec2(number_at(table, field_cell(cell.x, cell.y + 1, window)), ZERO)
        d = vec2(number_at(table, field_cell(cell.x + 1, cell.y + 1, window)), ZERO)
        low = between(end.to_next_x, a, end.rest_x, b)
        high = between(end.to_next_x, c, end.rest_x, d)
        return between(end.to_next_y, low, end.rest_y, high)

    # Return the exponent of the normal in two parts: where the peak is high, exponent and log peak nearly cancel.
    # terms[6] = {hit, 1 / (2 sigma^2), rand, log z_max, and the low parts of terms 0 and 1}. hit is z_hit / (sigma
    # sqrt(2 pi)) and rand is z_rand / range_max, or their logarithms in the log domain.
    @wp.func
    def field_exponent(distance: vec2, terms: wp.array(dtype=real)):
        if SHARP:
            return pair_product(pair_product(distance, distance), vec2(terms[1], terms[5]))
        else:
            return vec2(distance.x * (distance.x * terms[1]), ZERO)

    # Return log p of the distance from an end point to the nearest obstacle.
    if LINEAR:

        @wp.func
        def log_field(distance: vec2, terms: wp.array(dtype=real)):
            p = terms[2]
            if HIT:
                exponent = field_exponent(distance, terms)
                p += terms[0] * wp.exp(-exponent.x) * (ONE - exponent.y)
            return wp.log(p)

    else:

        @wp.func
        def log_field(distance: vec2, terms: wp.array(dtype=real)):
            exponent = field_exponent(distance, terms)
            hit = (terms[0] - exponent.x) + (terms[4] - exponent.y)
            largest = wp.max(hit, terms[2])
            return largest + wp.log(wp.exp(hit - largest) + wp.exp(terms[2] - largest))

    # Return the term of one reading. The table holds log densities, or cubes of densities (CUBES), or, where it is
    # interpolated, capped distances in metres.
    @wp.func
    def reading_value(
        table: wp.array(dtype=real),
        origin: wp.vec2i,
        pose: vec4,
        low: vec4,
        point: vec2,
        point_low: vec2,
        terms: wp.array(dtype=real),
        window: types.Window,
        guard: real,
    ):
        if ALL_READINGS:
            if wp.isnan(point.x):
                return ZERO
            if wp.isinf(point.x):
                return terms[3]
        end = end_point(pose, low, point, point_low, SHIFT, guard)
        cell = origin + end.cell
        if BILINEAR:
            return log_field(bilinear(table, cell, end, window), terms)
        else:
            value = number_at(table, field_cell(cell.x, cell.y, window))
            if LOG_TABLE:
                return value
            else:
                return log_field(vec2(value, ZERO), terms)

    return SimpleNamespace(
        between=between, bilinear=bilinear, field_exponent=field_exponent, log_field=log_field,
        reading_value=reading_value,
    )  # fmt: skip


@functools.cache
def make(name, flags):
    """Make a kernel of the file for a set of flags."""
    types = precision(flags)
    real, vec2, vec4 = types.real, types.vec2, types.vec4
    reading_value = functions(flags).reading_value
    ends = end_points.functions(flags)
    end_point, rounded_cell, ROUNDING_BITS = ends.end_point, ends.rounded_cell, ends.ROUNDING_BITS
    table_origin, table_cell, rounding_margin = ends.table_origin, ends.table_cell, ends.rounding_margin
    add_term = error_free.functions(flags).add_term
    CAREFUL = "CAREFUL" in flags
    CUBES = "CUBES" in flags
    PER_BEAM = "PER_BEAM" in flags
    ALL_READINGS = "ALL_READINGS" in flags
    QUICK = "QUICK" in flags
    SCANS = "SCANS" in flags
    ZERO, HALF = real(0.0), real(0.5)
    # Constants of loops that Warp shall unroll.
    WHOLE_BLOCK, HALF_BLOCK = 16, 8
    number_at, cell_at, point_at, pose_at = reader(real), reader(wp.vec2i), reader(vec2), reader(vec4)
    two_at = reader(vec2, 2)
    block_cells = wp.types.vector(length=BLOCK_TERMS, dtype=wp.int32)

    # Return the term of a reading by rounding alone, and the distance of the end point from the cell's centre. A
    # missing or max reading has no cell: the sensor's cell is read and not used. The term of a max reading is far.
    @wp.func
    def quick_value(
        table: wp.array(dtype=real),
        start_cell: wp.vec2i,
        lowered: vec4,
        to: vec2,
        far: real,
        window: types.Window,
    ):
        if ALL_READINGS:
            is_range = wp.isfinite(to.x)
            near, off = rounded_cell(lowered, wp.where(is_range, to, vec2(ZERO, ZERO)))
            value = number_at(table, table_cell(near, start_cell, window))
            if not is_range:
                off = ZERO
                value = wp.where(wp.isinf(to.x), far, ZERO)
        else:
            near, off = rounded_cell(lowered, to)
            value = number_at(table, table_cell(near, start_cell, window))
        return value, off

    # Return the term of a reading in a block where rounding is in doubt: doubtful cells are computed with more digits.
    @wp.func
    def careful_value(
        table: wp.array(dtype=real),
        origin: wp.vec2i,
        lowered: vec4,
        sensor_pose: vec4,
        sensor_low: vec4,
        to: vec2,
        to_low: vec2,
        far: real,
        window: types.Window,
        guard: real,
        sure: real,
    ):
        if ALL_READINGS:
            if wp.isnan(to.x):
                return ZERO
            if wp.isinf(to.x):
                return far
        near, off = rounded_cell(lowered, to)
        cell = wp.vec2i(near.x - ROUNDING_BITS, near.y - ROUNDING_BITS)
        if off > sure:
            exact = end_point(sensor_pose, sensor_low, to, to_low, ZERO, guard)
            cell = exact.cell
        return number_at(table, field_cell(origin.x + cell.x, origin.y + cell.y, window))

    # Fill width x height cells of the table, the first of them at begin, from squared distances: density has a value
    # for each squared distance up to the cap. The first cell is (from_col, from_row) of the grid; cells outside the
    # grid get beyond.
    @kernel
    def fill_field(
        squared: wp.array(dtype=wp.int32),
        density: wp.array(dtype=real),
        table: wp.array(dtype=real),
        rows: wp.int32,
        cols: wp.int32,
        cap: wp.int32,
        beyond: real,
        from_col: wp.int32,
        from_row: wp.int32,
        width: wp.int32,
        height: wp.int32,
        begin: wp.int32,
        stride: wp.int32,
    ):
        j, i = wp.tid()
        if i >= width or j >= height:
            return
        col = from_col + i
        row = from_row + j
        value = beyond
        if col >= 0 and col < cols and row >= 0 and row < rows:
            value = density[wp.min(squared[row * cols + col], cap)]
        table[begin + j * stride + i] = value

    # Score scans: one work-item takes a particle.
    @kernel
    def score_field(
        table: wp.array(dtype=real),
        pose_cell: wp.array(dtype=wp.vec2i),
        pose: wp.array(dtype=vec4),
        pose_low: wp.array(dtype=vec4),
        point: wp.array(dtype=vec2),
        point_low: wp.array(dtype=vec2),
        terms: wp.array(dtype=real),
        start: wp.array(dtype=wp.int32),
        constant_terms: wp.array(dtype=real),
        log_p: wp.array(dtype=real),
        parts: wp.array(dtype=real),
        window: types.Window,
        particles: wp.int32,
        readings: wp.int32,
        guard: real,
        score: types.Score,
        batch: types.ScanBatch,
    ):
        n = wp.tid()
        if n >= particles:
            return
        origin = pose_cell[n]
        sensor_pose = pose[n]
        sensor_low = vec4()
        if CAREFUL:
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
        if QUICK:
            # First all cells of a block, then all look-ups. On processors the first loop becomes vector code and takes
            # a third of the time; with points read as vec2, or a maximum in place of a count, it would not.
            lowered = sensor_pose - vec4(HALF, HALF, ZERO, ZERO)
            start_cell = table_origin(origin, window.cols)
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
                    cells[i] = table_cell(near, start_cell, window)
                    i += 1
                if doubtful > 0:
                    i = int(0)
                    while i < width:
                        exact = end_point(sensor_pose, sensor_low, point[first + i], point_low[first + i], ZERO, guard)
                        cells[i] = field_cell(origin.x + exact.cell.x, origin.y + exact.cell.y, window)
                        i += 1
                block = ZERO
                i = int(0)
                while i < width:
                    term = table[cells[i]]
                    if PER_BEAM:
                        parts[n * readings + k + i] = term
                    block += term
                    i += 1
                total = add_term(total, block)
                k += width
        else:
            while k < size:
                to = point[begin + k]
                to_low = vec2()
                if CAREFUL:
                    to_low = point_low[begin + k]
                term = reading_value(table, origin, sensor_pose, sensor_low, to, to_low, terms, window, guard)
                if PER_BEAM:
                    parts[n * readings + k] = term
                block += term
                k += 1
                if k % BLOCK_TERMS == 0:
                    total = add_term(total, block)
                    block = ZERO
            total = add_term(total, block)
        # An impossible reading keeps total.x at -inf and turns total.y into nan.
        if CUBES:
            log_p[n] = score.temperature * wp.log(total.x + total.y)
        elif wp.isinf(total.x):
            log_p[n] = total.x
        else:
            log_p[n] = score.temperature * (total.x + total.y)

    # Write the sums of blocks of readings to parts[n + block * particles], for GPUs. One work-item takes a
    # particle and every 2^spread-th block. Each block has a guard of its own; with SCANS each scan has as many guards
    # as the longest one.
    @kernel
    def field_blocks(
        table: wp.array(dtype=real),
        pose_cell: wp.array(dtype=wp.vec2i),
        pose: wp.array(dtype=vec4),
        pose_low: wp.array(dtype=vec4),
        point: wp.array(dtype=vec2),
        point_low: wp.array(dtype=vec2),
        terms: wp.array(dtype=real),
        guard: wp.array(dtype=real),
        start: wp.array(dtype=wp.int32),
        parts: wp.array(dtype=real),
        window: types.Window,
        particles: wp.int32,
        readings: wp.int32,
        spread: wp.int32,
        batch: types.ScanBatch,
    ):
        item = work_item(wp.tid())
        n = ((item // GROUP) >> spread) * GROUP + item % GROUP
        if n >= particles:
            return
        origin = cell_at(pose_cell, n)
        sensor_pose = pose_at(pose, n)
        sensor_low = vec4()
        if CAREFUL:
            sensor_low = pose_at(pose_low, n)
        if QUICK:
            lowered = sensor_pose - vec4(HALF, HALF, ZERO, ZERO)
            start_cell = table_origin(origin, window.cols)
            far = number_at(terms, 3)
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
            if QUICK:
                sure = rounding_margin(block_guard)
                worst = real(0.0)
                if begin + BLOCK_TERMS <= end:
                    if SCANS:
                        for i in range(WHOLE_BLOCK):
                            to = point_at(point, begin + i)
                            value, off = quick_value(table, start_cell, lowered, to, far, window)
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
                    k = begin
                    while k < end:
                        to = point_at(point, k)
                        value, off = quick_value(table, start_cell, lowered, to, far, window)
                        worst = wp.max(worst, off)
                        total += value
                        k += 1
                if worst > sure:
                    total = ZERO
                    k = begin
                    while k < end:
                        to, to_low = point_at(point, k), point_at(point_low, k)
                        total += careful_value(
                            table, origin, lowered, sensor_pose, sensor_low, to, to_low, far, window, block_guard, sure
                        )
                        k += 1
            else:
                k = begin
                while k < end:
                    to_low = vec2()
                    if CAREFUL:
                        to_low = point_at(point_low, k)
                    to = point_at(point, k)
                    total += reading_value(
                        table, origin, sensor_pose, sensor_low, to, to_low, terms, window, block_guard
                    )
                    k += 1
            parts[n + block * particles] = total
            block += 1 << spread

    return {"fill_field": fill_field, "score_field": score_field, "field_blocks": field_blocks}[name]
