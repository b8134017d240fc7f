// Likelihood field of a whole scan (book table 6.3): one look-up at each beam's end point.
// The table is padded by a ring of two cells that hold what lies outside the grid, so no look-up needs a bounds test.
// requires: lanes error_free

#define FIELD_RING 2
// Particles of a work-group of field_blocks.
#define GROUP 64

// Values of width x height cells of the table, the first of them at begin, from squared distances by a table of all
// squared distances up to the cap. Cell (from_col, from_row) of the squared distances comes first; beyond them is beyond.
kernel void fill_field(global const int *squared, global const real *density, global real *table, const int rows,
                       const int cols, const int cap, const real beyond, const int from_col, const int from_row,
                       const int width, const int height, const int begin, const int stride) {
    const int i = get_global_id(0), j = get_global_id(1), col = from_col + i, row = from_row + j;
    if (i >= width || j >= height) return;
    const int inside = col >= 0 && col < cols && row >= 0 && row < rows;
    table[begin + (long)j * stride + i] = inside ? density[min(squared[(long)row * cols + col], cap)] : beyond;
}

// i held to [0, last]; some drivers call clamp as a function.
int within(const int i, const int last) { return i < 0 ? 0 : i > last ? last : i; }

// Index of a cell of the padded table; far cells become ring cells.
int field_cell(const int col, const int row, const int rows, const int cols) {
    const int c = within(col + FIELD_RING, cols + 2 * FIELD_RING - 1);
    const int r = within(row + FIELD_RING, rows + 2 * FIELD_RING - 1);
    return r * (cols + 2 * FIELD_RING) + c;
}

// The same where no end point of the cloud leaves the table.
int table_cell(const int col, const int row, const int rows, const int cols) {
#if INSIDE
    return (row + FIELD_RING) * (cols + 2 * FIELD_RING) + col + FIELD_RING;
#else
    return field_cell(col, row, rows, cols);
#endif
}

#if CAREFUL
// frac + a b - c d (sign -1) or frac + a b + c d (sign +1) where every factor is a sum of two reals; to about twice
// the working precision.
real2 careful_offset(const real2 frac, const real2 a, const real2 b, const real2 c, const real2 d, const real sign) {
    const real2 ab = two_product(a.x, b.x), cd = two_product(c.x, d.x);
    const real2 products = two_sum(ab.x, sign * cd.x);
    const real2 sum = two_sum(products.x, frac.x);
    const real low = (a.x * b.y + a.y * b.x) + sign * (c.x * d.y + c.y * d.x);
    return (real2)(sum.x, ((ab.y + sign * cd.y) + (products.y + frac.y)) + (low + sum.y));
}
#endif

// Largest integer not above a.
int floor_int(const real a) {
    const int whole = (int)a;
    return whole - ((real)whole > a);
}

// Whole cells below an offset of two parts. What is left of it in [0, 1) is rest, and what is missing to 1 is to_next:
// both found relative to the nearest edge, where small numbers keep their digits. An offset that is EDGE or less short
// of an edge lies on it, so that end points on edges fall into the same cell in every precision.
#define EDGE ((real)1.1641532182693481e-10)

int whole_cells(const real2 offset, real2 *rest, real2 *to_next) {
    const int nearest = floor_int(offset.x + (real)0.5);
#if SHARP
    const real2 past = two_sum(offset.x - (real)nearest, offset.y);
    const real2 other = pair_sum((real2)(1, 0), past.x < 0 ? past : -past);
#else
    const real2 past = (real2)((offset.x - (real)nearest) + offset.y, 0);
    const real2 other = (real2)(past.x < 0 ? 1 + past.x : 1 - past.x, 0);
#endif
    const int below = past.x + EDGE < 0;
    *rest = below ? other : past;
    *to_next = below ? -past : other;
    return nearest - below;
}

// Where an end point lies: its cell as an offset from the pose's cell, and its place between that cell's edges.
typedef struct {
    int2 cell;
    real2 rest_x, rest_y, to_next_x, to_next_y;
} EndPoint;

// point is the reading times the beam's (cos, sin), in cells; shift moves cell centres onto corners. An end point
// nearer to a cell's edge than guard, the bound of its rounding errors, is found again with twice the digits.
EndPoint end_point(const real4 pose, const real4 pose_low, const real2 point, const real2 point_low, const real shift,
                   const real guard) {
    EndPoint end;
    real2 x = (real2)((pose.x - shift) + (pose.z * point.x - pose.w * point.y), 0);
    real2 y = (real2)((pose.y - shift) + (pose.w * point.x + pose.z * point.y), 0);
#if CAREFUL
#if !BILINEAR
    const int2 near = (int2)(floor_int(x.x), floor_int(y.x));
    const real2 left = (real2)(x.x - (real)near.x, y.x - (real)near.y);
    if (left.x >= guard && left.y >= guard && left.x <= 1 - guard && left.y <= 1 - guard) {
        end.cell = near;
        return end;
    }
#endif
    const real2 c = (real2)(pose.z, pose_low.z), s = (real2)(pose.w, pose_low.w);
    const real2 p = (real2)(point.x, point_low.x), q = (real2)(point.y, point_low.y);
    x = careful_offset(two_sum(pose.x, -shift) + (real2)(0, pose_low.x), c, p, s, q, (real)-1);
    y = careful_offset(two_sum(pose.y, -shift) + (real2)(0, pose_low.y), s, p, c, q, (real)1);
#endif
    end.cell.x = whole_cells(x, &end.rest_x, &end.to_next_x);
    end.cell.y = whole_cells(y, &end.rest_y, &end.to_next_y);
    return end;
}

#if BILINEAR
// a and b weighed by two numbers of two parts; a sum of terms that are not negative, so small values keep their digits.
real2 between(const real2 weight_a, const real2 a, const real2 weight_b, const real2 b) {
#if SHARP
    return pair_sum(pair_product(weight_a, a), pair_product(weight_b, b));
#else
    return (real2)(weight_a.x * a.x + weight_b.x * b.x, 0);
#endif
}

// Smooth distance between the four cell centres around an end point, in two parts.
real2 bilinear(global const real *table, const int2 cell, const EndPoint end, const int rows, const int cols) {
    const real2 a = (real2)(table[field_cell(cell.x, cell.y, rows, cols)], 0);
    const real2 b = (real2)(table[field_cell(cell.x + 1, cell.y, rows, cols)], 0);
    const real2 c = (real2)(table[field_cell(cell.x, cell.y + 1, rows, cols)], 0);
    const real2 d = (real2)(table[field_cell(cell.x + 1, cell.y + 1, rows, cols)], 0);
    const real2 low = between(end.to_next_x, a, end.rest_x, b), high = between(end.to_next_x, c, end.rest_x, d);
    return between(end.to_next_y, low, end.rest_y, high);
}
#endif

#if !LOG_TABLE
// terms[6] = {hit, 1 / (2 sigma^2), rand, log z_max, and what rounding took from terms 0 and 1}: z_hit / (sigma sqrt(2 pi))
// and z_rand / range_max, logarithms in the log domain. Where the peak is high, exponent and log peak nearly cancel.
real log_field(const real2 distance, global const real *terms) {
#if SHARP
    const real2 exponent = pair_product(pair_product(distance, distance), (real2)(terms[1], terms[5]));
#else
    const real2 exponent = (real2)(distance.x * (distance.x * terms[1]), 0);
#endif
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

// What one reading adds: the table holds log densities, or cubes of densities whose sum's logarithm is wanted, or capped
// distances in metres where it is interpolated.
real reading_value(global const real *table, const int2 origin, const real4 pose, const real4 low, const real2 point,
                   const real2 point_low, global const real *terms, const int rows, const int cols, const real guard) {
#if ALL_READINGS
    if (isnan(point.x)) return 0;
    if (isinf(point.x)) return terms[3];
#endif
#if BILINEAR
    const EndPoint end = end_point(pose, low, point, point_low, (real)0.5, guard);
    return log_field(bilinear(table, origin + end.cell, end, rows, cols), terms);
#else
    const EndPoint end = end_point(pose, low, point, point_low, 0, guard);
    const real value = table[field_cell(origin.x + end.cell.x, origin.y + end.cell.y, rows, cols)];
#if LOG_TABLE
    return value;
#else
    return log_field((real2)(value, 0), terms);
#endif
#endif
}

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
                        global const real *terms, global real *log_p, global real *parts, const int rows,
                        const int cols, const int particles, const int readings, const real guard,
                        const real fixed, const real temperature) {
    const int begin = LANES * get_global_id(0), left = particles - begin;
    if (get_global_id(0) % VECTORS != 0 || left <= 0) return;
    const int stride = cols + 2 * FIELD_RING, count = left < VECTORS * LANES ? left : VECTORS * LANES;
    Particles all[VECTORS];
    lanes head[VECTORS], lost[VECTORS];
    for (int v = 0; v * LANES < count; ++v) {
        Particles *of = &all[v];
        head[v] = fixed;
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
    for (int from = 0; from < readings; from += BLOCK_TERMS) {
        const int size = readings - from < BLOCK_TERMS ? readings - from : BLOCK_TERMS;
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
#else
// One work-item a particle.
kernel void score_field(global const real *table, global const int2 *pose_cell, global const real4 *pose,
                        global const real4 *pose_low, global const real2 *point, global const real2 *point_low,
                        global const real *terms, global real *log_p, global real *parts, const int rows,
                        const int cols, const int particles, const int readings, const real guard,
                        const real fixed, const real temperature) {
    const int n = get_global_id(0);
    if (n >= particles) return;
    const int2 origin = pose_cell[n];
#if CAREFUL
    const real4 low = pose_low[n];
#else
    const real4 low = (real4)(0);
#endif
    real2 total = (real2)(fixed, 0);
    real block = 0;
    for (int k = 0; k < readings; ++k) {
        const real term =
            reading_value(table, origin, pose[n], low, point[k], point_low[k], terms, rows, cols, guard);
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
    log_p[n] = temperature * log(total.x + total.y);
#else
    log_p[n] = isinf(total.x) ? total.x : temperature * (total.x + total.y);
#endif
}
#endif

#if !WIDE
#if QUICK
// Nearest cell of an end point, whose place is given half a cell lower: rounded to nearest. off is how far the place is
// off the cell's centre, along the axis where it is farther.
int2 rounded_cell(const real4 lowered, const real2 point, real *off) {
    const real x = lowered.x + (lowered.z * point.x - lowered.w * point.y);
    const real y = lowered.y + (lowered.w * point.x + lowered.z * point.y);
    const real to_x = x + ROUNDING, to_y = y + ROUNDING;
    *off = fmax(fabs(x - (to_x - ROUNDING)), fabs(y - (to_y - ROUNDING)));
    return (int2)(as_int(to_x), as_int(to_y)) - 0x4b400000;
}
#endif

// For GPUs, one work-item a particle and every 2^spread-th block of readings: the block's sum, at
// parts[n * across + block * along]. Each block has its own guard.
kernel void field_blocks(global const real *table, global const int2 *pose_cell, global const real4 *pose,
                         global const real4 *pose_low, global const real2 *point, global const real2 *point_low,
                         global const real *terms, global const real *guard, global real *parts, const int rows,
                         const int cols, const int particles, const int readings, const int across, const int along,
                         const int spread) {
    const int item = get_global_id(0), n = ((item / GROUP) >> spread) * GROUP + item % GROUP;
    if (n >= particles) return;
    const int2 origin = pose_cell[n];
    const real4 own = pose[n];
#if CAREFUL
    const real4 low = pose_low[n];
#else
    const real4 low = (real4)(0);
#endif
    for (int block = (item / GROUP) & ((1 << spread) - 1); block * BLOCK_TERMS < readings; block += 1 << spread) {
        const int begin = block * BLOCK_TERMS, end = min(begin + BLOCK_TERMS, readings);
        real sum = 0;
#if QUICK
        real worst = 0, off;
        const real4 lowered = own - (real4)(0.5f, 0.5f, 0, 0);
        const real sure = (real)0.5 - guard[block];
        if (begin + BLOCK_TERMS <= readings) {
#pragma unroll
            for (int i = 0; i < BLOCK_TERMS; ++i) {
                const int2 cell = origin + rounded_cell(lowered, point[begin + i], &off);
                worst = fmax(worst, off);
                sum += table[table_cell(cell.x, cell.y, rows, cols)];
            }
        } else {
            for (int k = begin; k < end; ++k) {
                const int2 cell = origin + rounded_cell(lowered, point[k], &off);
                worst = fmax(worst, off);
                sum += table[table_cell(cell.x, cell.y, rows, cols)];
            }
        }
        if (worst > sure) {
            sum = 0;
            for (int k = begin; k < end; ++k) {
                int2 cell = rounded_cell(lowered, point[k], &off);
                if (off > sure) cell = end_point(own, low, point[k], point_low[k], 0, guard[block]).cell;
                sum += table[field_cell(origin.x + cell.x, origin.y + cell.y, rows, cols)];
            }
        }
#else
        for (int k = begin; k < end; ++k)
            sum += reading_value(table, origin, own, low, point[k], point_low[k], terms, rows, cols, guard[block]);
#endif
        parts[(long)n * across + (long)block * along] = sum;
    }
}
#endif
