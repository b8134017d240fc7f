// End points of a block of beams and the terms of their readings, for LANES particles at once: field_term.cl in lanes.
// Look-ups have the bits of the scalar functions; interpolation takes exp and log of vectors, which may differ in the last
// bit.
// requires: lanes/end_point lanes/math lanes/hit_shape

// Adding and subtracting ROUND_INT rounds to nearest; the bits of the sum, less ROUND_BITS, are the integer.
#define ROUND_INT 12582912.0f
#define ROUND_BITS 0x4b400000

// Poses of LANES particles: cells of the padded table, fractions of a cell, and directions. Low parts belong to
// float32.
typedef struct {
    ilanes col, row;
    lanes x, y, cos, sin, x_low, y_low, cos_low, sin_low;
} Particles;

// Return the offset of end points in cells from the corners of the particles' cells, or with BILINEAR from their centres.
void offsets_lanes(const Particles *particle, const real2 point, const real2 point_low, LanePair *x, LanePair *y) {
#if TWO_PART_POINTS
    const real2 p = (real2)(point.x, point_low.x), q = (real2)(point.y, point_low.y);
    *x = careful_offset_lanes(particle->x, particle->x_low, particle->cos, particle->cos_low, p, particle->sin,
                              particle->sin_low, q, -1);
    *y = careful_offset_lanes(particle->y, particle->y_low, particle->sin, particle->sin_low, p, particle->cos,
                              particle->cos_low, q, 1);
#else
    *x = (LanePair){particle->x + (particle->cos * point.x - particle->sin * point.y), 0};
    *y = (LanePair){particle->y + (particle->sin * point.x + particle->cos * point.y), 0};
#endif
}

#if BILINEAR
// Return the weighted sum of distances of one part; only weights and sums of EXACT_EXPONENT have two.
LanePair between_cells_lanes(const LanePair weight_a, const lanes a, const LanePair weight_b, const lanes b) {
#if EXACT_EXPONENT
    return pair_sum_lanes(pair_times_lanes(weight_a, a), pair_times_lanes(weight_b, b));
#else
    return (LanePair){weight_a.hi * a + weight_b.hi * b, 0};
#endif
}

// Return the weighted sum of a and b.
LanePair between_lanes(const LanePair weight_a, const LanePair a, const LanePair weight_b, const LanePair b) {
#if EXACT_EXPONENT
    return pair_sum_lanes(pair_product_lanes(weight_a, a), pair_product_lanes(weight_b, b));
#else
    return (LanePair){weight_a.hi * a.hi + weight_b.hi * b.hi, 0};
#endif
}

// Return log p of distances from end points to the nearest obstacles: log_field of field_term.cl.
lanes log_distance_lanes(const LanePair distance, global const real *terms) {
#if EXACT_EXPONENT
    const LanePair square = pair_product_lanes(pair_product_lanes(distance, distance), (LanePair){terms[1], terms[5]});
#else
    const LanePair square = {distance.hi * (distance.hi * terms[1]), 0};
#endif
    const LanePair exponent = shape_exponent_lanes(square, terms[6], terms[7]);
#if LINEAR
    lanes p = terms[2];
#if HIT
    const lanes hit = terms[0] * exp_lanes(-exponent.hi);
#if EXACT_EXPONENT
    p += hit > 0 ? hit * (1 - exponent.lo) : hit;
#else
    p += hit;
#endif
#endif
    return log_lanes(p);
#else
    const lanes hit = (terms[0] - exponent.hi) + (terms[4] - exponent.lo);
#if RAND
    const lanes random = terms[2];
    const lanes largest = hit > random ? hit : random;
    const lanes sum = largest + log_lanes(exp_lanes(hit - largest) + exp_lanes(random - largest));
    return largest == -INFINITY ? largest : sum;
#else
    return hit;
#endif
#endif
}

// End points of a block of beams between four cell centres: the cell of the first, and the place between them.
typedef struct {
    ilanes cell[BLOCK_TERMS];
    lanes rest_x[BLOCK_TERMS], rest_y[BLOCK_TERMS], to_next_x[BLOCK_TERMS], to_next_y[BLOCK_TERMS];
#if EXACT_EXPONENT
    lanes rest_x_low[BLOCK_TERMS], rest_y_low[BLOCK_TERMS], to_next_x_low[BLOCK_TERMS], to_next_y_low[BLOCK_TERMS];
#endif
} EndPoints;

// Find the places of a block's end points. Both cells of the ring hold the same value, so the four cells are neighbours
// even beyond an edge.
void find_places(EndPoints *ends, const Particles *particle, global const real2 *point, global const real2 *point_low,
                 const int size, const Window window) {
    const int stride = window.cols + 2 * FIELD_RING;
    for (int k = 0; k < size; ++k) {
        LanePair x, y, rest_x, rest_y, to_next_x, to_next_y;
        offsets_lanes(particle, point[k], point_low[k], &x, &y);
        const ilanes to_col = whole_cells_lanes(x, &rest_x, &to_next_x);
        const ilanes to_row = whole_cells_lanes(y, &rest_y, &to_next_y);
        const ilanes c = within_lanes(particle->col + to_col, stride - 2);
        const ilanes r = within_lanes(particle->row + to_row, window.rows + 2 * FIELD_RING - 2);
        ends->cell[k] = r * stride + c;
        ends->rest_x[k] = rest_x.hi, ends->rest_y[k] = rest_y.hi;
        ends->to_next_x[k] = to_next_x.hi, ends->to_next_y[k] = to_next_y.hi;
#if EXACT_EXPONENT
        ends->rest_x_low[k] = rest_x.lo, ends->rest_y_low[k] = rest_y.lo;
        ends->to_next_x_low[k] = to_next_x.lo, ends->to_next_y_low[k] = to_next_y.lo;
#endif
    }
}

// Interpolate the distances of a block's end points; those of EXACT_EXPONENT have two parts. distance_low may be distance.
void interpolate(lanes *distance, lanes *distance_low, const EndPoints *ends, global const real *table, const int size,
                 const Window window) {
    global const real *above = table + window.cols + 2 * FIELD_RING;
    for (int k = 0; k < size; ++k) {
        const lane_int *at = (const lane_int *)&ends->cell[k];
        lanes a, b, d, e;
        gather_pairs(table, at, &a, &b);
        gather_pairs(above, at, &d, &e);
#if EXACT_EXPONENT
        const LanePair rest_x = {ends->rest_x[k], ends->rest_x_low[k]}, rest_y = {ends->rest_y[k], ends->rest_y_low[k]};
        const LanePair to_next_x = {ends->to_next_x[k], ends->to_next_x_low[k]};
        const LanePair to_next_y = {ends->to_next_y[k], ends->to_next_y_low[k]};
#else
        const LanePair rest_x = {ends->rest_x[k], 0}, rest_y = {ends->rest_y[k], 0};
        const LanePair to_next_x = {ends->to_next_x[k], 0}, to_next_y = {ends->to_next_y[k], 0};
#endif
        const LanePair low = between_cells_lanes(to_next_x, a, rest_x, b);
        const LanePair high = between_cells_lanes(to_next_x, d, rest_x, e);
        const LanePair found = between_lanes(to_next_y, low, rest_y, high);
        distance_low[k] = found.lo;
        distance[k] = found.hi;
    }
}
#elif FLOAT64
// Cells of a block's end points. Their coordinates are whole numbers of float64, which every processor clamps and
// multiplies fast.
typedef struct {
    int8 cell[BLOCK_TERMS];
} EndPoints;

// Return the whole cells below offsets: whole_cells_lanes, as whole numbers.
lanes cells_below(const lanes offset) {
    const lanes up = offset + 0.5, near = (up + LANE_INTEGERS) - LANE_INTEGERS;
    const lanes nearest = near > up ? near - 1 : near;
    return (offset - nearest) + EDGE < 0 ? nearest - 1 : nearest;
}

// Clamp whole numbers to [0, last].
lanes held_lanes(const lanes i, const lanes last) {
    const lanes raised = i > 0 ? i : (lanes)0;
    return raised < last ? raised : last;
}

// Find the cells of a block's end points.
void find_cells(EndPoints *ends, const Particles *particle, global const real2 *point, const int size,
                const Window window) {
    const real stride = window.cols + 2 * FIELD_RING;
    const lanes last_col = stride - 1, last_row = window.rows + 2 * FIELD_RING - 1;
    const lanes col = to_lanes(particle->col), row = to_lanes(particle->row);
    for (int k = 0; k < size; ++k) {
        LanePair x, y;
        offsets_lanes(particle, point[k], point[k], &x, &y);
        const lanes c = held_lanes(col + cells_below(x.hi), last_col), r = held_lanes(row + cells_below(y.hi), last_row);
        ends->cell[k] = convert_int8_rtz(r * stride + c);
    }
}
#else
// End points of a block of beams: nearest cells, and the distances from the centres of these cells.
typedef struct {
    ilanes cell[BLOCK_TERMS], off[BLOCK_TERMS];
} EndPoints;

// Find the cells of a block's end points by rounding; return whether a distance from a centre exceeds least.
int find_cells(EndPoints *ends, const Particles *particle, global const real2 *point, const int size,
               const Window window, const real least) {
    const int stride = window.cols + 2 * FIELD_RING;
    const lanes x = particle->x, y = particle->y, cos = particle->cos, sin = particle->sin;
    const ilanes col = particle->col, row = particle->row;
    global const real *to = (global const real *)point;
    ilanes worst = 0;
    for (int k = 0; k < size; ++k) {
        const lanes at_x = x + (cos * to[2 * k] - sin * to[2 * k + 1]), near_x = at_x + ROUND_INT;
        const lanes at_y = y + (sin * to[2 * k] + cos * to[2 * k + 1]), near_y = at_y + ROUND_INT;
        const ilanes off_x = size_bits(at_x - (near_x - ROUND_INT));
        const ilanes off_y = size_bits(at_y - (near_y - ROUND_INT));
        const ilanes off = off_x > off_y ? off_x : off_y;
        const ilanes c = within_lanes(as_ilanes(near_x) - ROUND_BITS + col, stride - 1);
        const ilanes r = within_lanes(as_ilanes(near_y) - ROUND_BITS + row, window.rows + 2 * FIELD_RING - 1);
        ends->cell[k] = r * stride + c;
        ends->off[k] = off;
        worst = worst > off ? worst : off;
    }
    return any_lane(worst > as_int(least));
}

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
