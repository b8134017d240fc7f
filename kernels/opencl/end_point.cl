// The cell of the likelihood field's table in which a beam's end point lies, and the point's place within that cell.
// Cells must be the same on every device and in every precision: an end point nearer to an edge than guard, the bound
// of its rounding errors, is recomputed with twice the digits.
// requires: error_free

// Clamp i to [0, last]; some drivers call clamp as a function.
integer within(const integer i, const int last) {
    const integer least = 0, most = last, raised = i > least ? i : least;
    return raised < most ? raised : most;
}

// Return the index of a cell of the padded table; far cells become ring cells.
int field_cell(const int col, const int row, const Window window) {
    const int c = within(col + FIELD_RING, window.cols + 2 * FIELD_RING - 1);
    const int r = within(row + FIELD_RING, window.rows + 2 * FIELD_RING - 1);
    return r * (window.cols + 2 * FIELD_RING) + c;
}

#if TWO_PART_POINTS
// Return frac + a b + sign c d to about twice the working precision; every factor is a sum of two numbers.
real2 careful_offset(const real2 frac, const real2 a, const real2 b, const real2 c, const real2 d, const real sign) {
    const real2 ab = two_product(a.x, b.x), cd = two_product(c.x, d.x);
    const real2 products = two_sum(ab.x, sign * cd.x);
    const real2 sum = two_sum(products.x, frac.x);
    const real low = (a.x * b.y + a.y * b.x) + sign * (c.x * d.y + c.y * d.x);
    return (real2)(sum.x, ((ab.y + sign * cd.y) + (products.y + frac.y)) + (low + sum.y));
}
#endif

// Offsets this close below an edge count as on it.
#define EDGE ((real)1.1641532182693481e-10)

// Return the whole cells below an offset of two parts; rest in [0, 1) is the remainder and to_next is 1 minus it. Both
// are computed relative to the nearest edge, where small numbers keep their digits. An offset at most EDGE below an
// edge counts as on it, so that end points on edges fall into the same cell in every precision.
integer whole_cells(const real2 offset, real2 *rest, real2 *to_next) {
    const integer nearest = floor_int(offset.x + (real)0.5);
#if EXACT_EXPONENT
    const real2 past = two_sum(offset.x - to_real(nearest), offset.y), back = (real2)(-past.x, -past.y);
    const real2 less = where_pair(past.x < 0, past, back), sum = ordered_sum((real)1, less.x);
    const real2 other = ordered_sum(sum.x, sum.y + less.y);
#else
    const real2 past = (real2)((offset.x - to_real(nearest)) + offset.y, 0), back = (real2)(-past.x, 0);
    const real2 other = (real2)(past.x < 0 ? 1 + past.x : 1 - past.x, 0);
#endif
    const integer below = past.x + EDGE < 0;
    *rest = where_pair(below, other, past);
    *to_next = where_pair(below, back, other);
    return nearest - (below & 1);
}

// An end point: its cell as an offset from the pose's cell, and its place between the edges of that cell.
typedef struct {
    int2 cell;
    real2 rest_x, rest_y, to_next_x, to_next_y;
} EndPoint;

// Return the end point of a beam. point is the reading times the beam's (cos, sin), in cells; shift moves cell centres
// onto corners. An end point nearer to a cell's edge than guard, the bound of its rounding errors, is recomputed with
// twice the digits.
EndPoint end_point(const real4 pose, const real4 pose_low, const real2 point, const real2 point_low, const real shift,
                   const real guard) {
    EndPoint end;
    real2 x = (real2)((pose.x - shift) + (pose.z * point.x - pose.w * point.y), 0);
    real2 y = (real2)((pose.y - shift) + (pose.w * point.x + pose.z * point.y), 0);
#if TWO_PART_POINTS
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

#if ROUNDED_CELLS
// Return the largest distance from a cell's centre at which rounding certainly gives the cell: half a cell less the
// rounding errors of an end point. guard bounds them for rounded products, with 3.12 eps of the reading and 1.5 eps
// altogether. Here products are not rounded, since GPUs fuse them, and the errors are 2 eps and 1.6 eps.
real rounding_margin(const real guard) { return 0.5f - 0.6875f * guard; }

// The bits of ROUNDING: the bits of a sum with ROUNDING, less these, are an integer.
#define ROUNDING_BITS 0x4b400000

// Return the cell of an end point plus ROUNDING_BITS, by rounding to nearest; lowered is the pose less half a cell. off
// is the distance from the cell's centre along the axis where it is larger.
int2 rounded_cell(const real4 lowered, const real2 point, real *off) {
    const real x = fma(lowered.z, point.x, fma(-lowered.w, point.y, lowered.x));
    const real y = fma(lowered.w, point.x, fma(lowered.z, point.y, lowered.y));
    const real to_x = x + ROUNDING, to_y = y + ROUNDING;
    *off = fmax(fabs(x - (to_x - ROUNDING)), fabs(y - (to_y - ROUNDING)));
    return (int2)(as_int(to_x), as_int(to_y));
}

// Return the origin for table_cell, from the pose's cell. Where no end point of the cloud leaves the table (INSIDE), an
// index is a sum and a product modulo 2^32, and ROUNDING_BITS are subtracted once per pose.
int2 table_origin(const int2 origin, const int cols) {
#if INSIDE
    const uint stride = cols + 2 * FIELD_RING, more = FIELD_RING - ROUNDING_BITS;
    return (int2)(((uint)origin.y + more) * stride + (uint)origin.x + more, stride);
#else
    return origin - ROUNDING_BITS;
#endif
}

// Return the index of the cell of rounded_cell in the padded table, from the origin of table_origin.
int table_cell(const int2 near, const int2 from, const Window window) {
#if INSIDE
    return (uint)near.y * (uint)from.y + ((uint)near.x + (uint)from.x);
#else
    return field_cell(from.x + near.x, from.y + near.y, window);
#endif
}
#endif
