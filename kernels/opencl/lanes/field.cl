// Likelihood field of LANES particles at once: score_field of field.cl. Look-ups have the bits of the scalar kernel;
// interpolation takes exp and log of vectors, which may differ in the last bit.
// requires: lanes/end_point

// Vectors of particles per work-item. They share each block of beams: while a robot is tracked, its end points lie in
// few cells of the table. There is a work-item for each vector; the first of VECTORS does the work of all of them.
#define VECTORS 4

// Adding and subtracting ROUND_INT rounds to nearest; the bits of the sum, less ROUND_BITS, are the integer.
#define ROUND_INT 12582912.0f
#define ROUND_BITS 0x4b400000

// Poses of LANES particles: cells of the padded table, fractions of a cell, and directions.
typedef struct {
    ilanes col, row;
    lanes x, y, cos, sin;
#if BILINEAR
    lanes x_low, y_low, cos_low, sin_low;
#endif
} Particles;

#if BILINEAR
// Return log p of one beam. Both cells of the ring hold the same value, so the four cells are neighbours even beyond an
// edge.
lanes log_field_lanes(global const real *table, const Particles *particle, const real2 point, const real2 point_low,
                      global const real *terms, const Window window) {
    const real2 p = (real2)(point.x, point_low.x), q = (real2)(point.y, point_low.y);
    const int stride = window.cols + 2 * FIELD_RING;
    lanes rest_x, rest_y, to_next_x, to_next_y;
    const LanePair x = careful_offset_lanes(particle->x, particle->x_low, particle->cos, particle->cos_low, p,
                                            particle->sin, particle->sin_low, q, -1);
    const ilanes to_col = whole_cells_lanes(x, &rest_x, &to_next_x);
    const LanePair y = careful_offset_lanes(particle->y, particle->y_low, particle->sin, particle->sin_low, p,
                                            particle->cos, particle->cos_low, q, 1);
    const ilanes to_row = whole_cells_lanes(y, &rest_y, &to_next_y);
    const ilanes c = within_lanes(particle->col + to_col, stride - 2);
    const ilanes r = within_lanes(particle->row + to_row, window.rows + 2 * FIELD_RING - 2);
    const ilanes index = r * stride + c;
    const int *at = (const int *)&index;
    global const real *right = table + 1, *above = table + stride, *opposite = above + 1;
    const lanes low = to_next_x * GATHER_AT(lanes, table, at) + rest_x * GATHER_AT(lanes, right, at);
    const lanes high = to_next_x * GATHER_AT(lanes, above, at) + rest_x * GATHER_AT(lanes, opposite, at);
    const lanes distance = to_next_y * low + rest_y * high;
    lanes density = terms[2];
#if HIT
    density += terms[0] * exp(-(distance * (distance * terms[1])));
#endif
    return log(density);
}
#else
// End points of a block of beams: nearest cells, and the distances from the centres of these cells.
typedef struct {
    ilanes cell[BLOCK_TERMS], off[BLOCK_TERMS];
} EndPoints;

// Recompute the cells of end points whose distance from the centre exceeds most, with twice the digits.
__attribute__((noinline)) void refine_cells(EndPoints *ends, const real *most, const int first, const int count,
                                            global const int2 *pose_cell, global const real4 *pose,
                                            global const real4 *pose_low, global const real2 *point,
                                            global const real2 *point_low, const int size, const Window window,
                                            const real guard) {
    for (int k = 0; k < size; ++k) {
        if (!any_lane(ends->off[k] > as_int(most[k]))) continue;
        int *cell = (int *)&ends->cell[k], *off = (int *)&ends->off[k];
        for (int i = 0; i < count; ++i) {
            if (off[i] <= as_int(most[k])) continue;
            const int n = first + i;
            const EndPoint end = end_point(pose[n], pose_low[n], point[k], point_low[k], 0, guard);
            cell[i] = field_cell(pose_cell[n].x + end.cell.x, pose_cell[n].y + end.cell.y, window);
        }
    }
}
#endif

// Score scans: one work-item takes VECTORS * LANES particles, and the beams block by block.
kernel void score_field(global const real *table, global const int2 *pose_cell, global const real4 *pose,
                        global const real4 *pose_low, global const real2 *point, global const real2 *point_low,
                        global const real *terms, global const int *start, global const real *constant_terms,
                        global real *log_p, global real *parts, const Window window, const int particles,
                        const int readings, const real guard, const Score score, const ScanBatch batch) {
    const int item = get_global_id(0);
#if SCANS
    // No work-item has particles of two scans.
    const int items = (batch.per_scan + VECTORS * LANES - 1) / (VECTORS * LANES) * VECTORS, scan = item / items;
    const int begin = scan * batch.per_scan + LANES * (item % items), left = (scan + 1) * batch.per_scan - begin;
    if (item % VECTORS != 0 || left <= 0 || begin >= particles) return;
    const int all_readings = start[scan + 1] - start[scan];
    const real constant_term = constant_terms[scan];
    point += start[scan];
    point_low += start[scan];
#else
    const int begin = LANES * item, left = particles - begin, all_readings = readings;
    const real constant_term = score.constant_term;
    if (item % VECTORS != 0 || left <= 0) return;
#endif
    const int stride = window.cols + 2 * FIELD_RING, count = left < VECTORS * LANES ? left : VECTORS * LANES;
    Particles all[VECTORS];
    lanes total[VECTORS], total_low[VECTORS];
    for (int v = 0; v * LANES < count; ++v) {
        Particles *particle = &all[v];
        total[v] = constant_term;
        total_low[v] = 0;
        for (int i = 0; i < LANES; ++i) {
            const int lane = v * LANES + i, n = begin + (lane < count ? lane : count - 1);
            ((int *)&particle->col)[i] = pose_cell[n].x + FIELD_RING;
            ((int *)&particle->row)[i] = pose_cell[n].y + FIELD_RING;
            ((real *)&particle->x)[i] = pose[n].x;
            ((real *)&particle->y)[i] = pose[n].y;
            ((real *)&particle->cos)[i] = pose[n].z;
            ((real *)&particle->sin)[i] = pose[n].w;
#if BILINEAR
            ((real *)&particle->x_low)[i] = pose_low[n].x;
            ((real *)&particle->y_low)[i] = pose_low[n].y;
            ((real *)&particle->cos_low)[i] = pose_low[n].z;
            ((real *)&particle->sin_low)[i] = pose_low[n].w;
#endif
        }
        // Subtract half a cell: interpolation is between centres, and rounding to nearest must give the cell.
#if BILINEAR
        const LanePair x = two_sum_lanes(particle->x, -0.5f), y = two_sum_lanes(particle->y, -0.5f);
        particle->x = x.hi, particle->x_low = x.lo + particle->x_low;
        particle->y = y.hi, particle->y_low = y.lo + particle->y_low;
#else
        particle->x -= 0.5f;
        particle->y -= 0.5f;
#endif
    }
#if !BILINEAR
    EndPoints ends;
    real most[BLOCK_TERMS];
#endif
    for (int from = 0; from < all_readings; from += BLOCK_TERMS) {
        const int size = all_readings - from < BLOCK_TERMS ? all_readings - from : BLOCK_TERMS;
#if !BILINEAR
        // Rounding errors of an end point are at most 2.5 eps times its reading in cells, plus 0.7 eps.
        real least = 0.5f;
        for (int k = 0; k < size; ++k) {
            const real2 to = point[from + k];
            const real near = 3.6e-7f * ((to.x < 0 ? -to.x : to.x) + (to.y < 0 ? -to.y : to.y) + 1);
            most[k] = 0.5f - (near < guard ? near : guard);
            least = most[k] < least ? most[k] : least;
        }
#endif
        for (int v = 0; v * LANES < count; ++v) {
            const int first = begin + v * LANES, used = count - v * LANES < LANES ? count - v * LANES : LANES;
            lanes block = 0;
#if !BILINEAR
            const lanes x = all[v].x, y = all[v].y, cos = all[v].cos, sin = all[v].sin;
            const ilanes col = all[v].col, row = all[v].row;
            global const real *to = (global const real *)(point + from);
            ilanes worst = 0;
            for (int k = 0; k < size; ++k) {
                const lanes at_x = x + (cos * to[2 * k] - sin * to[2 * k + 1]), near_x = at_x + ROUND_INT;
                const lanes at_y = y + (sin * to[2 * k] + cos * to[2 * k + 1]), near_y = at_y + ROUND_INT;
                const ilanes off_x = size_bits(at_x - (near_x - ROUND_INT));
                const ilanes off_y = size_bits(at_y - (near_y - ROUND_INT));
                const ilanes off = off_x > off_y ? off_x : off_y;
                const ilanes c = within_lanes(as_ilanes(near_x) - ROUND_BITS + col, stride - 1);
                const ilanes r = within_lanes(as_ilanes(near_y) - ROUND_BITS + row, window.rows + 2 * FIELD_RING - 1);
                ends.cell[k] = r * stride + c;
                ends.off[k] = off;
                worst = worst > off ? worst : off;
            }
            if (any_lane(worst > as_int(least)))
                refine_cells(&ends, most, first, used, pose_cell, pose, pose_low, point + from, point_low + from, size,
                             window, guard);
#pragma unroll 4
#endif
            for (int k = 0; k < size; ++k) {
#if BILINEAR
                const lanes term = log_field_lanes(table, &all[v], point[from + k], point_low[from + k], terms, window);
#else
                const int *at = (const int *)&ends.cell[k];
                const lanes term = GATHER_AT(lanes, table, at);
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
    for (int i = 0; i < count; ++i) {
        const real high = ((const real *)total)[i];
        log_p[begin + i] = isinf(high) ? high : score.temperature * (high + ((const real *)total_low)[i]);
    }
}
