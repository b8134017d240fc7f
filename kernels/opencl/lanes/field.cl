// Likelihood field of LANES particles at once: score_field of field.cl.
// Lanes share a table: in several worlds (WORLDS), neighbours of one world are scored together.
// requires: lanes/ahead lanes/field_term

// Particles of a work-item, in vectors. They share each block of beams: while a robot is tracked, its end points fall
// into few cells of the table. There is a work-item for each 16 particles; the first of ITEMS does the work of all of
// them.
#define TOGETHER 64
#define ITEMS 4
#define VECTORS (TOGETHER / LANES)

#if WORLDS
// Return the lines of the field of the next particle's world; none if it is the same one, see lines_ahead.
Lines next_field(global const real *tables, global const int2 *world, const int n, const int next, const int particles,
                 const int reads) {
    const Lines none = {0, 0};
    if (next >= particles || world[2 * next].x == world[2 * n].x) return none;
    const Window seen = world_window(world, next);
    const long size = (long)(seen.rows + 2 * FIELD_RING) * (seen.cols + 2 * FIELD_RING) * sizeof(real);
    return lines_ahead((size_t)(tables + world_begin(world, next, 1)), size, 0, 1, reads);
}
#endif

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
    const int end = begin + (left < TOGETHER ? left : TOGETHER);
    for (int base = begin, count; base < end; base += count) {
#if WORLDS
        count = 1;
        while (base + count < end && world[2 * (base + count)].x == world[2 * base].x) ++count;
        const Window seen = world_window(world, base);
        global const real *cells = table + world_begin(world, base, 1);
        const int steps = (count + LANES - 1) / LANES * all_readings;
        Lines ahead = next_field(table, world, base, base + count, particles, count * all_readings);
        const int lines_of_step = (int)((ahead.end - ahead.next) / CACHE_LINE + steps) / (steps + 1);
#else
        count = end - base;
        const Window seen = window;
        global const real *cells = table;
#endif
        FieldParticles all[VECTORS];
        LanePair total[VECTORS];
        for (int v = 0; v * LANES < count; ++v) {
            total[v] = (LanePair){constant_term, 0};
            for (int i = 0; i < LANES; ++i) {
                const int lane = v * LANES + i, n = base + (lane < count ? lane : count - 1);
                place_particle(&all[v], i, pose_cell[n], pose[n], pose_low[n]);
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
                const int first = base + v * LANES, used = count - v * LANES < LANES ? count - v * LANES : LANES;
                lanes block = 0;
#if BILINEAR
                EndPoints ends;
                LanePair square[BLOCK_TERMS];
                find_places(&ends, &all[v], point + from, point_low + from, size, seen);
                find_squares(square, &ends, cells, terms, size, seen);
#elif FLOAT64
                EndPoints ends;
                find_cells(&ends, &all[v], point + from, size, seen);
#else
                EndPoints ends;
                if (find_cells(&ends, &all[v], point + from, size, seen, margin))
                    refine_cells(&ends, &all[v], margin, first, used, pose_cell, pose, pose_low, point + from,
                                 point_low + from, size, seen, guard);
#pragma unroll 4
#endif
                for (int k = 0; k < size; ++k) {
                    fetch_lines(&ahead, lines_of_step);
#if BILINEAR
                    const lanes term = log_square_lanes(square[k], terms);
#else
                    const int *at = (const int *)&ends.cell[k];
                    const lanes term = GATHER_BY_TWO(lanes, cells, at);
#endif
#if PER_BEAM
                    for (int i = 0; i < used; ++i)
                        parts[(long)(first + i) * readings + from + k] = ((const real *)&term)[i];
#endif
                    block += term;
                }
                total[v] = add_term_lanes(total[v], block);
            }
        }
        for (int v = 0; v * LANES < count; ++v) {
#if CUBES
            const lanes sum = total[v].x + total[v].y;
            for (int i = 0; i < LANES && v * LANES + i < count; ++i)
                log_p[base + v * LANES + i] = score.temperature * log(((const real *)&sum)[i]);
#else
            const lanes sum = scaled_sum_lanes(total[v], score.temperature);
            store_some(sum, log_p + base + v * LANES, count - v * LANES);
#endif
        }
    }
}
