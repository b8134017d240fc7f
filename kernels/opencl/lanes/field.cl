// Likelihood field of LANES particles at once: score_field of field.cl.
// Lanes share a table, so the scalar body scores particles in several of them (WORLDS).
// requires: lanes/field_term

// Particles of a work-item, in vectors. They share each block of beams: while a robot is tracked, its end points fall
// into few cells of the table. There is a work-item for each 16 particles; the first of ITEMS does the work of all of
// them.
#define TOGETHER 64
#define ITEMS 4
#define VECTORS (TOGETHER / LANES)

// Score scans: one work-item takes TOGETHER particles, and the beams block by block.
kernel void score_field(ARGUMENTS) {
    const int item = get_global_id(0);
    if (item % ITEMS != 0) return;
#if SCANS
    // No work-item has particles of two scans.
    const int items = (batch.per_scan + TOGETHER - 1) / TOGETHER * ITEMS, scan = item / items;
    const int begin = scan * batch.per_scan + TOGETHER * (item % items / ITEMS);
    const int left = (scan + 1) * batch.per_scan - begin;
    if (left <= 0 || begin >= particles) return;
    const int all_readings = start[scan + 1] - start[scan];
    const real constant_term = constant_terms[scan];
    point += start[scan];
    point_low += start[scan];
#else
    const int begin = TOGETHER * (item / ITEMS), left = particles - begin, all_readings = readings;
    const real constant_term = score.constant_term;
    if (left <= 0) return;
#endif
    const int count = left < TOGETHER ? left : TOGETHER;
    Particles all[VECTORS];
    lanes total[VECTORS], total_low[VECTORS];
    for (int v = 0; v * LANES < count; ++v) {
        total[v] = constant_term;
        total_low[v] = 0;
        for (int i = 0; i < LANES; ++i) {
            const int lane = v * LANES + i, n = begin + (lane < count ? lane : count - 1);
            set_particle(&all[v], i, pose_cell[n], pose[n], pose_low[n]);
        }
    }
    for (int from = 0; from < all_readings; from += BLOCK_TERMS) {
        const int size = all_readings - from < BLOCK_TERMS ? all_readings - from : BLOCK_TERMS;
#if TWO_PART_POINTS
#if !BILINEAR
        const real margin = place_margin(point + from, size);
#endif
#endif
        for (int v = 0; v * LANES < count; ++v) {
            const int first = begin + v * LANES, used = count - v * LANES < LANES ? count - v * LANES : LANES;
            lanes block = 0;
#if BILINEAR
            EndPoints ends;
            LanePair square[BLOCK_TERMS];
            find_places(&ends, &all[v], point + from, point_low + from, size, window);
            find_squares(square, &ends, table, terms, size, window);
#elif FLOAT64
            EndPoints ends;
            find_cells(&ends, &all[v], point + from, size, window);
#else
            EndPoints ends;
            if (find_cells(&ends, &all[v], point + from, size, window, margin))
                refine_cells(&ends, &all[v], margin, first, used, pose_cell, pose, pose_low, point + from,
                             point_low + from, size, window, guard);
#pragma unroll 4
#endif
            for (int k = 0; k < size; ++k) {
#if BILINEAR
                const lanes term = log_square_lanes(square[k], terms);
#else
                const int *at = (const int *)&ends.cell[k];
                const lanes term = GATHER_BY_TWO(lanes, table, at);
#endif
#if PER_BEAM
                for (int i = 0; i < used; ++i)
                    parts[(long)(first + i) * readings + from + k] = ((const real *)&term)[i];
#endif
                block += term;
            }
            const lanes sum = total[v] + block, shift = sum - total[v];
            total_low[v] += (total[v] - (sum - shift)) + (block - shift);
            total[v] = sum;
        }
    }
#if CUBES
    for (int i = 0; i < count; ++i)
        log_p[begin + i] = score.temperature * log(((const real *)total)[i] + ((const real *)total_low)[i]);
#else
    for (int v = 0; v * LANES < count; ++v) {
        const lanes high = total[v], sum = score.temperature * (high + total_low[v]);
        store_some(high - high == 0 ? sum : high, log_p + begin + v * LANES, count - v * LANES);
    }
#endif
}
