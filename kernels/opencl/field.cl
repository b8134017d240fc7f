// Likelihood field of a whole scan (book table 6.3): one look-up at each beam's end point. The table is padded by a
// ring of two cells for everything outside the grid, so no look-up needs a bounds test.
// requires: end_point

// Particles per work-group of field_blocks.
#define GROUP 64

#if BILINEAR
// Return the weighted sum of a and b, all of two parts. No term is negative, so small values keep their digits.
real2 between(const real2 weight_a, const real2 a, const real2 weight_b, const real2 b) {
#if SHARP
    return pair_sum(pair_product(weight_a, a), pair_product(weight_b, b));
#else
    return (real2)(weight_a.x * a.x + weight_b.x * b.x, 0);
#endif
}

// Interpolate the distance between the four cell centres around an end point, in two parts.
real2 bilinear(global const real *table, const int2 cell, const EndPoint end, const Window window) {
    const real2 a = (real2)(table[field_cell(cell.x, cell.y, window)], 0);
    const real2 b = (real2)(table[field_cell(cell.x + 1, cell.y, window)], 0);
    const real2 c = (real2)(table[field_cell(cell.x, cell.y + 1, window)], 0);
    const real2 d = (real2)(table[field_cell(cell.x + 1, cell.y + 1, window)], 0);
    const real2 low = between(end.to_next_x, a, end.rest_x, b), high = between(end.to_next_x, c, end.rest_x, d);
    return between(end.to_next_y, low, end.rest_y, high);
}
#endif

#if !LOG_TABLE
// Return the exponent of the normal in two parts: where the peak is high, exponent and log peak nearly cancel. terms[6]
// = {hit, 1 / (2 sigma^2), rand, log z_max, and the low parts of terms 0 and 1}. hit is z_hit / (sigma sqrt(2 pi)) and
// rand is z_rand / range_max, or their logarithms in the log domain.
real2 field_exponent(const real2 distance, global const real *terms) {
#if SHARP
    return pair_product(pair_product(distance, distance), (real2)(terms[1], terms[5]));
#else
    return (real2)(distance.x * (distance.x * terms[1]), 0);
#endif
}

// Return log p of the distance from an end point to the nearest obstacle.
real log_field(const real2 distance, global const real *terms) {
    const real2 exponent = field_exponent(distance, terms);
#if LINEAR
    real p = terms[2];
#if HIT
    p += terms[0] * exp(-exponent.x) * (1 - exponent.y);
#endif
    return log(p);
#else
    const real hit = (terms[0] - exponent.x) + (terms[4] - exponent.y);
    const real largest = fmax(hit, terms[2]);
    return largest + log(exp(hit - largest) + exp(terms[2] - largest));
#endif
}
#endif

// Return the term of one reading. The table holds log densities, or cubes of densities (CUBES), or, where it is
// interpolated, capped distances in metres.
real reading_value(global const real *table, const int2 origin, const real4 pose, const real4 low, const real2 point,
                   const real2 point_low, global const real *terms, const Window window, const real guard) {
#if ALL_READINGS
    if (isnan(point.x)) return 0;
    if (isinf(point.x)) return terms[3];
#endif
#if BILINEAR
    const EndPoint end = end_point(pose, low, point, point_low, (real)0.5, guard);
    return log_field(bilinear(table, origin + end.cell, end, window), terms);
#else
    const EndPoint end = end_point(pose, low, point, point_low, 0, guard);
    const real value = table[field_cell(origin.x + end.cell.x, origin.y + end.cell.y, window)];
#if LOG_TABLE
    return value;
#else
    return log_field((real2)(value, 0), terms);
#endif
#endif
}

#if QUICK
// Return the term of a reading by rounding alone. worst becomes the distance of the end point from the cell's centre,
// if that is larger. A missing or max reading has no cell: the sensor's cell is read and not used. The term of a max
// reading is far.
real quick_value(global const real *table, const int2 from, const real4 lowered, const real2 point, const real far,
                 const Window window, real *worst) {
    real off;
#if ALL_READINGS
    const int is_range = isfinite(point.x);
    const int2 near = rounded_cell(lowered, is_range ? point : (real2)(0), &off);
    const real value = table[table_cell(near, from, window)];
    *worst = is_range ? fmax(*worst, off) : *worst;
    return is_range ? value : isinf(point.x) ? far : 0;
#else
    const int2 near = rounded_cell(lowered, point, &off);
    *worst = fmax(*worst, off);
    return table[table_cell(near, from, window)];
#endif
}

// Return the term of a reading in a block where rounding is in doubt: doubtful cells are computed with more digits.
real careful_value(global const real *table, const int2 origin, const real4 lowered, const real4 pose, const real4 low,
                   const real2 point, const real2 point_low, const real far, const Window window, const real guard,
                   const real sure) {
#if ALL_READINGS
    if (isnan(point.x)) return 0;
    if (isinf(point.x)) return far;
#endif
    real off;
    int2 cell = rounded_cell(lowered, point, &off) - ROUNDING_BITS;
    if (off > sure) cell = end_point(pose, low, point, point_low, 0, guard).cell;
    return table[field_cell(origin.x + cell.x, origin.y + cell.y, window)];
}
#endif

// Fill width x height cells of the table, the first of them at begin, from squared distances: density has a value for
// each squared distance up to the cap. The first cell is (from_col, from_row) of the grid; cells outside the grid get
// beyond.
kernel void fill_field(global const int *squared, global const real *density, global real *table, const int rows,
                       const int cols, const int cap, const real beyond, const int from_col, const int from_row,
                       const int width, const int height, const int begin, const int stride) {
    const int i = get_global_id(0), j = get_global_id(1), col = from_col + i, row = from_row + j;
    if (i >= width || j >= height) return;
    const int inside = col >= 0 && col < cols && row >= 0 && row < rows;
    table[begin + (long)j * stride + i] = inside ? density[min(squared[(long)row * cols + col], cap)] : beyond;
}

// Score scans: one work-item takes a particle. QUICK changes this kernel in Warp alone, on processors, whose compiler
// makes vector code of loops.
kernel void score_field(global const real *table, global const int2 *pose_cell, global const real4 *pose,
                        global const real4 *pose_low, global const real2 *point, global const real2 *point_low,
                        global const real *terms, global const int *start, global const real *constant_terms,
                        global real *log_p, global real *parts, const Window window, const int particles,
                        const int readings, const real guard, const Score score, const ScanBatch batch) {
    const int n = get_global_id(0);
    if (n >= particles) return;
#if SCANS
    const int scan = (n + batch.ahead) / batch.per_scan, size = start[scan + 1] - start[scan];
    const real constant_term = constant_terms[scan];
    point += start[scan];
    point_low += start[scan];
#else
    const int size = readings;
    const real constant_term = score.constant_term;
#endif
    const int2 origin = pose_cell[n];
#if CAREFUL
    const real4 low = pose_low[n];
#else
    const real4 low = (real4)(0);
#endif
    real2 total = (real2)(constant_term, 0);
    real block = 0;
    for (int k = 0; k < size; ++k) {
        const real term =
            reading_value(table, origin, pose[n], low, point[k], point_low[k], terms, window, guard);
#if PER_BEAM
        parts[(long)n * readings + k] = term;
#endif
        block += term;
        if ((k + 1) % BLOCK_TERMS == 0) {
            total = add_term(total, block);
            block = 0;
        }
    }
    total = add_term(total, block);
#if CUBES
    log_p[n] = score.temperature * log(total.x + total.y);
#else
    log_p[n] = isinf(total.x) ? total.x : score.temperature * (total.x + total.y);
#endif
}

// Write the sums of blocks of readings to parts[n + block * particles], for GPUs. One work-item takes a particle
// and every 2^spread-th block. Each block has a guard of its own; with SCANS each scan has as many guards as the
// longest one.
kernel void field_blocks(global const real *table, global const int2 *pose_cell, global const real4 *pose,
                         global const real4 *pose_low, global const real2 *point, global const real2 *point_low,
                         global const real *terms, global const real *guard, global const int *start,
                         global real *parts, const Window window, const int particles, const int readings,
                         const int spread, const ScanBatch batch) {
    const int item = get_global_id(0), n = ((item / GROUP) >> spread) * GROUP + item % GROUP;
    if (n >= particles) return;
#if SCANS
    const int scan = n / batch.per_scan, size = start[scan + 1] - start[scan];
    point += start[scan];
    point_low += start[scan];
    guard += scan * ((readings + BLOCK_TERMS - 1) / BLOCK_TERMS);
#else
    const int size = readings;
#endif
    const int2 origin = pose_cell[n];
    const real4 sensor_pose = pose[n];
#if CAREFUL
    const real4 low = pose_low[n];
#else
    const real4 low = (real4)(0);
#endif
#if QUICK
    const int2 from = table_origin(origin, window.cols);
    const real4 lowered = sensor_pose - (real4)(0.5f, 0.5f, 0, 0);
    const real far = terms[3];
#endif
    for (int block = (item / GROUP) & ((1 << spread) - 1); block * BLOCK_TERMS < size; block += 1 << spread) {
        const int begin = block * BLOCK_TERMS, end = min(begin + BLOCK_TERMS, size);
        real sum = 0;
#if QUICK
        real worst = 0;
        const real sure = rounding_margin(guard[block]);
        if (begin + BLOCK_TERMS <= size) {
#if SCANS
#pragma unroll
            for (int i = 0; i < BLOCK_TERMS; ++i)
                sum += quick_value(table, from, lowered, point[begin + i], far, window, &worst);
#else
            // The points of one scan are aligned, so that two of them can be read at once.
            global const real4 *two = (global const real4 *)(point + begin);
#pragma unroll
            for (int i = 0; i < BLOCK_TERMS / 2; ++i) {
                const real4 pair = two[i];
                sum += quick_value(table, from, lowered, pair.xy, far, window, &worst);
                sum += quick_value(table, from, lowered, pair.zw, far, window, &worst);
            }
#endif
        } else {
            for (int k = begin; k < end; ++k)
                sum += quick_value(table, from, lowered, point[k], far, window, &worst);
        }
        if (worst > sure) {
            sum = 0;
            for (int k = begin; k < end; ++k)
                sum += careful_value(table, origin, lowered, sensor_pose, low, point[k], point_low[k], far, window,
                                     guard[block], sure);
        }
#else
        for (int k = begin; k < end; ++k)
            sum += reading_value(table, origin, sensor_pose, low, point[k], point_low[k], terms, window, guard[block]);
#endif
        parts[n + (long)block * particles] = sum;
    }
}
