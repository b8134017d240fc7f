// Likelihood field of LANES particles at once in vector types, for processors; with the bits of the scalar field for
// look-ups, and of exp and log of vectors where it is interpolated. OpenCL only: see lanes.
// requires: lanes end_point

#if WIDE
// Vectors of particles of a work-item. They share each block of beams, whose end points lie in a few cells of the table
// while a robot is tracked. Work-items are launched one a vector, and the first of as many does the work of all.
#define VECTORS 4

// Adding and taking off a large number rounds to nearest, and the bits of the sum hold the integer.
#define ROUND_INT 12582912.0f
#define ROUND_BITS 0x4b400000

// Where LANES particles are: cells of the padded table, fractions and directions.
typedef struct {
    ilanes col, row;
    lanes x, y, cos, sin;
#if BILINEAR
    lanes x_low, y_low, cos_low, sin_low;
#endif
} Particles;

// Columns or rows held to [0, last].
ilanes held(const ilanes i, const int last) {
    const ilanes low = i > 0 ? i : 0;
    return low < last ? low : last;
}

#if BILINEAR
typedef struct {
    lanes x, y;
} Pair;

// The functions of the same names for LANES numbers, with the same bits.
Pair wide_two_sum(const lanes a, const lanes b) {
    const lanes sum = a + b, shift = sum - a;
    const Pair pair = {sum, (a - (sum - shift)) + (b - shift)};
    return pair;
}

Pair wide_two_product(const lanes a, const lanes b) {
    const lanes product = a * b, scaled_a = SPLITTER * a, scaled_b = SPLITTER * b;
    const lanes a_high = scaled_a - (scaled_a - a), b_high = scaled_b - (scaled_b - b);
    const lanes a_low = a - a_high, b_low = b - b_high;
    const Pair pair = {product, ((a_high * b_high - product) + a_high * b_low + a_low * b_high) + a_low * b_low};
    return pair;
}

Pair wide_careful_offset(const lanes frac, const lanes frac_low, const lanes a, const lanes a_low, const real2 b,
                         const lanes c, const lanes c_low, const real2 d, const real sign) {
    const Pair ab = wide_two_product(a, (lanes)b.x), cd = wide_two_product(c, (lanes)d.x);
    const Pair products = wide_two_sum(ab.x, sign * cd.x), sum = wide_two_sum(products.x, frac);
    const lanes low = (a * b.y + a_low * b.x) + sign * (c * d.y + c_low * d.x);
    const Pair pair = {sum.x, ((ab.y + sign * cd.y) + (products.y + frac_low)) + (low + sum.y)};
    return pair;
}

ilanes wide_whole_cells(const Pair offset, lanes *rest, lanes *to_next) {
    const lanes up = offset.x + 0.5f;
    ilanes nearest = to_ilanes(up);
    nearest += to_lanes(nearest) > up;
    const lanes past = (offset.x - to_lanes(nearest)) + offset.y, other = past < 0 ? 1 + past : 1 - past;
    const ilanes below = past + EDGE < 0;
    *rest = below ? other : past;
    *to_next = below ? -past : other;
    return nearest + below;
}

// Terms of one beam. Beyond the edges both cells of the ring hold the same, so the four cells are always neighbours.
lanes wide_term(global const real *table, const Particles *of, const real2 point, const real2 point_low,
                global const real *terms, const int rows, const int cols) {
    const real2 p = (real2)(point.x, point_low.x), q = (real2)(point.y, point_low.y);
    const int stride = cols + 2 * FIELD_RING;
    lanes rest_x, rest_y, to_next_x, to_next_y;
    const ilanes to_col = wide_whole_cells(
        wide_careful_offset(of->x, of->x_low, of->cos, of->cos_low, p, of->sin, of->sin_low, q, -1), &rest_x, &to_next_x);
    const ilanes to_row = wide_whole_cells(
        wide_careful_offset(of->y, of->y_low, of->sin, of->sin_low, p, of->cos, of->cos_low, q, 1), &rest_y, &to_next_y);
    const ilanes c = held(of->col + to_col, stride - 2), r = held(of->row + to_row, rows + 2 * FIELD_RING - 2);
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
// End points of a block of beams: their nearest cells, and how far from the cells' middles they lie.
typedef struct {
    ilanes cell[BLOCK_TERMS], off[BLOCK_TERMS];
} EndPoints;

// Cells of end points that are farther from the middle than most, found again with twice the digits.
__attribute__((noinline)) void mend_cells(EndPoints *ends, const real *most, const int first, const int count,
                                          global const int2 *pose_cell, global const real4 *pose,
                                          global const real4 *pose_low, global const real2 *point,
                                          global const real2 *point_low, const int size, const int rows,
                                          const int cols, const real guard) {
    for (int k = 0; k < size; ++k) {
        if (!some(ends->off[k] > as_int(most[k]))) continue;
        int *cell = (int *)&ends->cell[k], *off = (int *)&ends->off[k];
        for (int i = 0; i < count; ++i) {
            if (off[i] <= as_int(most[k])) continue;
            const int n = first + i;
            const EndPoint end = end_point(pose[n], pose_low[n], point[k], point_low[k], 0, guard);
            cell[i] = field_cell(pose_cell[n].x + end.cell.x, pose_cell[n].y + end.cell.y, rows, cols);
        }
    }
}
#endif

// One work-item VECTORS * LANES particles, block by block of beams.
kernel void score_field(global const real *table, global const int2 *pose_cell, global const real4 *pose,
                        global const real4 *pose_low, global const real2 *point, global const real2 *point_low,
                        global const real *terms, global const int *start, global const real *fixed_of,
                        global real *log_p, global real *parts, const int rows, const int cols, const int particles,
                        const int readings, const real guard, const real fixed, const real temperature,
                        const int per_scan, const int ahead) {
    const int item = get_global_id(0);
#if SCANS
    // Each scan has work-items of its own.
    const int items = (per_scan + VECTORS * LANES - 1) / (VECTORS * LANES) * VECTORS, scan = item / items;
    const int begin = scan * per_scan + LANES * (item % items), left = (scan + 1) * per_scan - begin;
    if (item % VECTORS != 0 || left <= 0 || begin >= particles) return;
    const int all_readings = start[scan + 1] - start[scan];
    const real lead = fixed_of[scan];
    point += start[scan];
    point_low += start[scan];
#else
    const int begin = LANES * item, left = particles - begin, all_readings = readings;
    const real lead = fixed;
    if (item % VECTORS != 0 || left <= 0) return;
#endif
    const int stride = cols + 2 * FIELD_RING, count = left < VECTORS * LANES ? left : VECTORS * LANES;
    Particles all[VECTORS];
    lanes head[VECTORS], lost[VECTORS];
    for (int v = 0; v * LANES < count; ++v) {
        Particles *of = &all[v];
        head[v] = lead;
        lost[v] = 0;
        for (int i = 0; i < LANES; ++i) {
            const int lane = v * LANES + i, n = begin + (lane < count ? lane : count - 1);
            ((int *)&of->col)[i] = pose_cell[n].x + FIELD_RING;
            ((int *)&of->row)[i] = pose_cell[n].y + FIELD_RING;
            ((real *)&of->x)[i] = pose[n].x;
            ((real *)&of->y)[i] = pose[n].y;
            ((real *)&of->cos)[i] = pose[n].z;
            ((real *)&of->sin)[i] = pose[n].w;
#if BILINEAR
            ((real *)&of->x_low)[i] = pose_low[n].x;
            ((real *)&of->y_low)[i] = pose_low[n].y;
            ((real *)&of->cos_low)[i] = pose_low[n].z;
            ((real *)&of->sin_low)[i] = pose_low[n].w;
#endif
        }
        // Half a cell is taken off: to centres that are corners, or so that rounding to nearest finds the cell.
#if BILINEAR
        const Pair x = wide_two_sum(of->x, -0.5f), y = wide_two_sum(of->y, -0.5f);
        of->x = x.x, of->x_low = x.y + of->x_low;
        of->y = y.x, of->y_low = y.y + of->y_low;
#else
        of->x -= 0.5f;
        of->y -= 0.5f;
#endif
    }
#if !BILINEAR
    EndPoints ends;
    real most[BLOCK_TERMS];
#endif
    for (int from = 0; from < all_readings; from += BLOCK_TERMS) {
        const int size = all_readings - from < BLOCK_TERMS ? all_readings - from : BLOCK_TERMS;
#if !BILINEAR
        // An end point's rounding errors are at most 2.5 eps (its reading in cells) + 0.7 eps.
        real least = 0.5f;
        for (int k = 0; k < size; ++k) {
            const real2 to = point[from + k];
            const real near = 3.6e-7f * ((to.x < 0 ? -to.x : to.x) + (to.y < 0 ? -to.y : to.y) + 1);
            most[k] = 0.5f - (near < guard ? near : guard);
            least = most[k] < least ? most[k] : least;
        }
#endif
        for (int v = 0; v * LANES < count; ++v) {
            const int here = begin + v * LANES, used = count - v * LANES < LANES ? count - v * LANES : LANES;
            lanes block = 0;
#if !BILINEAR
            const lanes x = all[v].x, y = all[v].y, cos = all[v].cos, sin = all[v].sin;
            const ilanes col = all[v].col, row = all[v].row;
            global const real *to = (global const real *)(point + from);
            ilanes worst = 0;
            for (int k = 0; k < size; ++k) {
                const lanes at_x = x + (cos * to[2 * k] - sin * to[2 * k + 1]), near_x = at_x + ROUND_INT;
                const lanes at_y = y + (sin * to[2 * k] + cos * to[2 * k + 1]), near_y = at_y + ROUND_INT;
                const ilanes off_x = size_bits(at_x - (near_x - ROUND_INT)), off_y = size_bits(at_y - (near_y - ROUND_INT));
                const ilanes off = off_x > off_y ? off_x : off_y;
                const ilanes c = held(as_ilanes(near_x) - ROUND_BITS + col, stride - 1);
                const ilanes r = held(as_ilanes(near_y) - ROUND_BITS + row, rows + 2 * FIELD_RING - 1);
                ends.cell[k] = r * stride + c;
                ends.off[k] = off;
                worst = worst > off ? worst : off;
            }
            if (some(worst > as_int(least)))
                mend_cells(&ends, most, here, used, pose_cell, pose, pose_low, point + from, point_low + from, size, rows,
                           cols, guard);
#pragma unroll 4
#endif
            for (int k = 0; k < size; ++k) {
#if BILINEAR
                const lanes term = wide_term(table, &all[v], point[from + k], point_low[from + k], terms, rows, cols);
#else
                const int *at = (const int *)&ends.cell[k];
                const lanes term = GATHER_AT(lanes, table, at);
#endif
#if PER_BEAM
                for (int i = 0; i < used; ++i) parts[(long)(here + i) * readings + from + k] = ((const real *)&term)[i];
#endif
                block += term;
            }
            const lanes sum = head[v] + block, shift = sum - head[v];
            lost[v] += (head[v] - (sum - shift)) + (block - shift);
            head[v] = sum;
        }
    }
    for (int i = 0; i < count; ++i) {
        const real total = ((const real *)head)[i];
        log_p[begin + i] = isinf(total) ? total : temperature * (total + ((const real *)lost)[i]);
    }
}
#endif
