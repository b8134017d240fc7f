// End points of a block of beams and the terms of their readings, for LANES particles at once: field_term.cl in lanes.
// Look-ups have the bits of the scalar functions; interpolation takes exp and log of vectors, which may differ in the last
// bit.
// requires: lanes/end_point lanes/math lanes/hit_shape

#if BILINEAR
// in lanes: between field_square log_square

#if FLOAT64
typedef Particles FieldParticles;

// Set the pose of a lane. Half a cell is subtracted: interpolation is between centres.
void place_particle(FieldParticles *particle, const int lane, const int2 cell, const real4 pose, const real4 pose_low) {
    set_particle(particle, lane, cell, pose, 0.5, 1);
}

// End points of a block of beams between four cell centres: the cell of the first, and the place between them.
typedef struct {
    ilanes cell[BLOCK_TERMS];
    LanePair rest_x[BLOCK_TERMS], rest_y[BLOCK_TERMS], to_next_x[BLOCK_TERMS], to_next_y[BLOCK_TERMS];
} EndPoints;

// Find the places of a block's end points. Both cells of the ring hold the same value, so the four cells are neighbours
// even beyond an edge.
void find_places(EndPoints *ends, const FieldParticles *particle, global const real2 *point, global const real2 *point_low,
                 const int size, const Window window) {
    const int stride = window.cols + 2 * FIELD_RING;
    const lanes cos = particle->cos, sin = particle->sin;
    for (int k = 0; k < size; ++k) {
        const LanePair x = {particle->x + (cos * point[k].x - sin * point[k].y), 0};
        const LanePair y = {particle->y + (sin * point[k].x + cos * point[k].y), 0};
        const ilanes to_col = whole_cells_lanes(x, &ends->rest_x[k], &ends->to_next_x[k]);
        const ilanes to_row = whole_cells_lanes(y, &ends->rest_y[k], &ends->to_next_y[k]);
        const ilanes c = within_lanes(particle->col + to_col, stride - 2);
        const ilanes r = within_lanes(particle->row + to_row, window.rows + 2 * FIELD_RING - 2);
        ends->cell[k] = r * stride + c;
    }
}

// Find the squares of the distances of a block's end points over 2 sigma^2.
void find_squares(LanePair *square, const EndPoints *ends, global const real *table, global const FieldTerms *terms,
                  const int size, const Window window) {
    for (int k = 0; k < size; ++k) {
        const lane_int *at = (const lane_int *)&ends->cell[k];
        LanePair a = {0, 0}, b = {0, 0}, c = {0, 0}, d = {0, 0};
        gather_pairs(table, at, &a.x, &b.x);
        gather_pairs(table + window.cols + 2 * FIELD_RING, at, &c.x, &d.x);
        const LanePair low = between_lanes(ends->to_next_x[k], a, ends->rest_x[k], b);
        const LanePair high = between_lanes(ends->to_next_x[k], c, ends->rest_x[k], d);
        square[k] = field_square_lanes(between_lanes(ends->to_next_y[k], low, ends->rest_y[k], high), terms);
    }
}
#else
// Half of the particles. Their places are computed in float64: sums of two numbers of float32 take three times as many
// operations.
typedef double8 half_lanes;
// A sum of it and an integer of either sign has the integer in its last 32 bits.
#define HALF_INTEGERS 6755399441055744.0

// Poses of LANES particles: cells of the padded table, fractions of a cell less one, and directions.
typedef struct {
    ilanes col, row;
    half_lanes x[2], y[2], cos[2], sin[2];
} FieldParticles;

// Set the pose of a lane. Half a cell is subtracted since interpolation is between centres, and half a cell more, so that
// rounding to nearest gives the cell below.
void place_particle(FieldParticles *particle, const int lane, const int2 cell, const real4 pose, const real4 pose_low) {
    ((int *)&particle->col)[lane] = cell.x + FIELD_RING;
    ((int *)&particle->row)[lane] = cell.y + FIELD_RING;
    ((double *)particle->x)[lane] = ((double)pose.x - 1) + pose_low.x;
    ((double *)particle->y)[lane] = ((double)pose.y - 1) + pose_low.y;
    ((double *)particle->cos)[lane] = (double)pose.z + pose_low.z;
    ((double *)particle->sin)[lane] = (double)pose.w + pose_low.w;
}

// End points of a block of beams between four cell centres: the cell of the first, and the place between them.
typedef struct {
    ilanes cell[BLOCK_TERMS];
#if EXACT_EXPONENT
    half_lanes rest_x[BLOCK_TERMS][2], rest_y[BLOCK_TERMS][2];
#else
    lanes rest_x[BLOCK_TERMS], rest_y[BLOCK_TERMS];
#endif
} EndPoints;

// Return a b + c, rounded once where the processor has a fused multiply-add.
half_lanes multiply_add(const half_lanes a, const double b, const half_lanes c) {
    return FUSES ? fma(a, (half_lanes)b, c) : a * b + c;
}

// Return both halves in float32.
lanes both_halves(const half_lanes *halves) {
    return (lanes)(convert_float8(halves[0]), convert_float8(halves[1]));
}

// Find the places of a block's end points. Both cells of the ring hold the same value, so the four cells are neighbours
// even beyond an edge. An end point on a cell's edge may count to either side: the interpolated distance is the same.
void find_places(EndPoints *ends, const FieldParticles *particle, global const real2 *point, global const real2 *point_low,
                 const int size, const Window window) {
    const int stride = window.cols + 2 * FIELD_RING;
    for (int k = 0; k < size; ++k) {
        const double to_x = (double)point[k].x + point_low[k].x, to_y = (double)point[k].y + point_low[k].y;
        half_lanes col[2], row[2], rest_x[2], rest_y[2];
        for (int i = 0; i < 2; ++i) {
            const half_lanes cos = particle->cos[i], sin = particle->sin[i];
            const half_lanes x = multiply_add(cos, to_x, multiply_add(-sin, to_y, particle->x[i]));
            const half_lanes y = multiply_add(sin, to_x, multiply_add(cos, to_y, particle->y[i]));
            col[i] = x + HALF_INTEGERS, row[i] = y + HALF_INTEGERS;
            rest_x[i] = (x - (col[i] - HALF_INTEGERS)) + 0.5;
            rest_y[i] = (y - (row[i] - HALF_INTEGERS)) + 0.5;
#if EXACT_EXPONENT
            ends->rest_x[k][i] = rest_x[i], ends->rest_y[k][i] = rest_y[i];
#endif
        }
#if !EXACT_EXPONENT
        ends->rest_x[k] = both_halves(rest_x), ends->rest_y[k] = both_halves(rest_y);
#endif
        const ilanes to_col = (ilanes)(as_int16(col[0]).even, as_int16(col[1]).even);
        const ilanes to_row = (ilanes)(as_int16(row[0]).even, as_int16(row[1]).even);
        const ilanes c = within_lanes(particle->col + to_col, stride - 2);
        const ilanes r = within_lanes(particle->row + to_row, window.rows + 2 * FIELD_RING - 2);
        ends->cell[k] = r * stride + c;
    }
}

#if EXACT_EXPONENT
// Return the squares of interpolated distances, times a factor.
half_lanes scaled_square(const float8 a, const float8 b, const float8 c, const float8 d, const half_lanes rest_x,
                         const half_lanes rest_y, const double factor) {
    const half_lanes left = convert_double8(a), low = left + rest_x * (convert_double8(b) - left);
    const half_lanes above = convert_double8(c), high = above + rest_x * (convert_double8(d) - above);
    const half_lanes distance = low + rest_y * (high - low);
    return distance * distance * factor;
}
#endif

// Find the squares of the distances of a block's end points over 2 sigma^2.
void find_squares(LanePair *square, const EndPoints *ends, global const real *table, global const FieldTerms *terms,
                  const int size, const Window window) {
    for (int k = 0; k < size; ++k) {
        const int *at = (const int *)&ends->cell[k];
        lanes a, b, c, d;
        gather_pairs(table, at, &a, &b);
        gather_pairs(table + window.cols + 2 * FIELD_RING, at, &c, &d);
#if EXACT_EXPONENT
        const double factor = (double)terms->square_scale + terms->square_scale_low;
        half_lanes both[2];
        both[0] = scaled_square(a.lo, b.lo, c.lo, d.lo, ends->rest_x[k][0], ends->rest_y[k][0], factor);
        both[1] = scaled_square(a.hi, b.hi, c.hi, d.hi, ends->rest_x[k][1], ends->rest_y[k][1], factor);
        const lanes high = both_halves(both);
        both[0] -= convert_double8(high.lo), both[1] -= convert_double8(high.hi);
        square[k] = (LanePair){high, both_halves(both)};
#else
        const lanes rest_x = ends->rest_x[k], rest_y = ends->rest_y[k], to_next_x = 1 - rest_x;
        const lanes low = to_next_x * a + rest_x * b, high = to_next_x * c + rest_x * d;
        square[k] = field_square_lanes((LanePair){(1 - rest_y) * low + rest_y * high, 0}, terms);
#endif
    }
}
#endif
#else
// Whole cells of the scaled places of end points below.
#define SCALE_BITS 17
#define FRACTION ((1 << SCALE_BITS) - 1)

typedef Particles FieldParticles;

// Set the pose of a lane; in float32, fractions and directions are scaled by 2^SCALE_BITS.
void place_particle(FieldParticles *particle, const int lane, const int2 cell, const real4 pose, const real4 pose_low) {
    set_particle(particle, lane, cell, pose, 0, FLOAT64 ? 1 : 1 << SCALE_BITS);
}

#if FLOAT64
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
void find_cells(EndPoints *ends, const FieldParticles *particle, global const real2 *point, const int size,
                const Window window) {
    const real stride = window.cols + 2 * FIELD_RING;
    const lanes last_col = stride - 1, last_row = window.rows + 2 * FIELD_RING - 1;
    const lanes col = to_lanes(particle->col), row = to_lanes(particle->row);
    for (int k = 0; k < size; ++k) {
        const lanes x = particle->x + (particle->cos * point[k].x - particle->sin * point[k].y);
        const lanes y = particle->y + (particle->sin * point[k].x + particle->cos * point[k].y);
        const lanes c = held_lanes(col + cells_below(x), last_col), r = held_lanes(row + cells_below(y), last_row);
        ends->cell[k] = convert_int8_rtz(r * stride + c);
    }
}
#else
// Cells of a block's end points.
typedef struct {
    ilanes cell[BLOCK_TERMS];
} EndPoints;

// Return the bound of the rounding errors of scaled places: 2 eps of the longest reading in cells and 3.5 eps (2.5 eps of it
// where products are rounded), and one for truncation.
real place_margin(global const real2 *point, const int size) {
    real square = 0;
    for (int k = 0; k < size; ++k) {
        const real here = point[k].x * point[k].x + point[k].y * point[k].y;
        square = here > square ? here : square;
    }
    const real longest = sqrt(square), scaled_eps = (1 << SCALE_BITS) * 1.2e-7f;
    // Longer readings are not scaled to 32 bits: all their cells are recomputed.
    if (longest >= (1 << (30 - SCALE_BITS))) return 1 << SCALE_BITS;
    return (int)(scaled_eps * ((FUSES ? 2.02f : 2.52f) * longest + 4)) + 2;
}

// Find the scaled places of an end point, larger by margin than its coordinates.
void scaled_places(const FieldParticles *particle, global const real2 *point, const real margin, ilanes *x, ilanes *y) {
    // Two loads are faster than a load of two.
    global const real *to = (global const real *)point;
    const lanes cos = particle->cos, sin = particle->sin, to_x = to[0], to_y = to[1];
    *x = to_ilanes(multiply_add_lanes(cos, to_x, multiply_add_lanes(-sin, to_y, particle->x + margin)));
    *y = to_ilanes(multiply_add_lanes(sin, to_x, multiply_add_lanes(cos, to_y, particle->y + margin)));
}

// Find the cells of a block's end points; return whether an end point may be within margin of a cell's edge.
int find_cells(EndPoints *ends, const FieldParticles *particle, global const real2 *point, const int size,
               const Window window, const real margin) {
    const uint stride = window.cols + 2 * FIELD_RING;
    const uint16 last_col = stride - 1, last_row = window.rows + 2 * FIELD_RING - 1;
    const ilanes col = particle->col, row = particle->row;
    ilanes least = FRACTION;
    for (int k = 0; k < size; ++k) {
        ilanes x, y;
        scaled_places(particle, point + k, margin, &x, &y);
        const ilanes past_x = x & FRACTION, past_y = y & FRACTION, past = past_x < past_y ? past_x : past_y;
        // All cells of the ring hold the same value.
        const uint16 c = as_uint16((x >> SCALE_BITS) + col), r = as_uint16((y >> SCALE_BITS) + row);
        ends->cell[k] = as_int16((r < last_row ? r : last_row) * stride + (c < last_col ? c : last_col));
        least = least < past ? least : past;
    }
    return any_lane(least <= 2 * (int)margin);
}

// Recompute the cells of end points that may be within margin of a cell's edge, with twice the digits.
__attribute__((noinline)) void refine_cells(EndPoints *ends, const FieldParticles *particle, const real margin,
                                            const int first, const int count, global const int2 *pose_cell,
                                            global const real4 *pose, global const real4 *pose_low,
                                            global const real2 *point, global const real2 *point_low, const int size,
                                            const Window window, const real guard) {
    for (int k = 0; k < size; ++k) {
        ilanes x, y;
        scaled_places(particle, point + k, margin, &x, &y);
        const ilanes close = ((x & FRACTION) <= 2 * (int)margin) | ((y & FRACTION) <= 2 * (int)margin);
        if (!any_lane(close)) continue;
        int *cell = (int *)&ends->cell[k];
        for (int i = 0; i < count; ++i) {
            if (!((const int *)&close)[i]) continue;
            const int n = first + i;
            const EndPoint end = end_point(pose[n], pose_low[n], point[k], point_low[k], 0, guard);
            cell[i] = field_cell(pose_cell[n].x + end.cell.x, pose_cell[n].y + end.cell.y, window);
        }
    }
}
#endif
#endif
