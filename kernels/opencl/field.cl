// Likelihood field of a whole scan (book table 6.3): one look-up at each beam's end point. A ring of two cells around
// the table represents everything outside the grid, so no look-up needs a bounds test.
// requires: field_term

// Particles per work-group of field_blocks.
#define GROUP 64

#if ROUNDED_CELLS
// Return the sum of the readings from begin to end by rounded cells, again with more digits where an end point is too near
// to an edge.
real rounded_block(global const real *table, const int2 origin, const real4 pose, const real4 low,
                   global const real2 *point, global const real2 *point_low, const int begin, const int end,
                   const real far, const Window window, const real guard) {
    const int2 from = table_origin(origin, window.cols);
    const real4 lowered = pose - (real4)(0.5f, 0.5f, 0, 0);
    const real sure = rounding_margin(guard);
    real sum = 0, worst = 0;
    if (begin + BLOCK_TERMS <= end) {
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
        for (int k = begin; k < end; ++k) sum += quick_value(table, from, lowered, point[k], far, window, &worst);
    }
    if (worst > sure) {
        sum = 0;
        for (int k = begin; k < end; ++k)
            sum += careful_value(table, origin, lowered, pose, low, point[k], point_low[k], far, window, guard, sure);
    }
    return sum;
}
#endif

// Return log p of a scan from its sum of two parts. An impossible reading keeps the first at -inf and turns the second into
// nan.
real field_log(const real2 total, const real temperature) {
#if CUBES
    return temperature * log(total.x + total.y);
#else
    return scaled_sum(total, temperature);
#endif
}

// Score scans: one work-item takes a particle. ROUNDED_CELLS changes this kernel in Warp alone, on processors: their
// compiler vectorises loops.
kernel void score_field(ARGUMENTS) {
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
#if TWO_PART_POINTS
    const real4 low = pose_low[n];
#else
    const real4 low = (real4)(0);
#endif
#if WORLDS
    const Window seen = world_window(world, n);
    table += world_begin(world, n, 1);
#else
    const Window seen = window;
#endif
    real2 total = (real2)(constant_term, 0);
    real block = 0;
    for (int k = 0; k < size; ++k) {
        const real term =
            reading_value(table, origin, pose[n], low, point[k], point_low[k], terms, seen, guard, shapes, world, crowd,
                          n);
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
    log_p[n] = field_log(total, score.temperature);
}

// Write the sums of blocks of readings to parts[n + block * particles], for GPUs. One work-item takes a particle
// and every 2^spread-th block. Each block has a separate guard; with SCANS each scan has as many guards as the longest
// one.
kernel void field_blocks(ARGUMENTS) {
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
#if TWO_PART_POINTS
    const real4 low = pose_low[n];
#else
    const real4 low = (real4)(0);
#endif
#if WORLDS
    const Window seen = world_window(world, n);
    table += world_begin(world, n, 1);
#else
    const Window seen = window;
#endif
    for (int block = (item / GROUP) & ((1 << spread) - 1); block * BLOCK_TERMS < size; block += 1 << spread) {
        const int begin = block * BLOCK_TERMS, end = min(begin + BLOCK_TERMS, size);
#if ROUNDED_CELLS
        const real sum = rounded_block(table, origin, sensor_pose, low, point, point_low, begin, end, terms->z_max, seen,
                                       guard[block]);
#else
        real sum = 0;
        for (int k = begin; k < end; ++k)
            sum += reading_value(table, origin, sensor_pose, low, point[k], point_low[k], terms, seen, guard[block],
                                 shapes, world, crowd, n);
#endif
        parts[n + (long)block * particles] = sum;
    }
}
