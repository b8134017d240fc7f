// Gradient and information of LANES particles at once: field_gradient of field_gradient.cl. End points are rounded to
// the working precision: the interpolated distance is continuous, so an error of an end point moves it by as much.
// requires: lanes/end_point

#define GRADIENT_NUMBERS 10

// A work-item takes LANES particles of one scan.
kernel void field_gradient(global const real *table, global const int2 *pose_cell, global const real4 *pose,
                           global const real4 *pose_low, global const real2 *point, global const real2 *point_low,
                           global const real *terms, global const int *start, global const real *constant_terms,
                           global real *gradient, const Window window, const int particles, const int readings,
                           const real guard, const real mount_x, const real mount_y, const real resolution,
                           const Score score, const ScanBatch batch) {
    const int begin = LANES * get_global_id(0);
    if (begin >= particles) return;
    const int count = particles - begin < LANES ? particles - begin : LANES;
    const int stride = window.cols + 2 * FIELD_RING, last_row = window.rows + 2 * FIELD_RING - 2;
    global const real *right = table + 1, *above = table + stride, *opposite = above + 1;
    ilanes col, row;
    lanes x, y, cos, sin;
    for (int i = 0; i < LANES; ++i) {
        const int n = begin + (i < count ? i : count - 1);
        ((int *)&col)[i] = pose_cell[n].x + FIELD_RING;
        ((int *)&row)[i] = pose_cell[n].y + FIELD_RING;
        // Half a cell less: interpolation is between centres.
        ((real *)&x)[i] = (pose[n].x - 0.5f) + pose_low[n].x;
        ((real *)&y)[i] = (pose[n].y - 0.5f) + pose_low[n].y;
        ((real *)&cos)[i] = pose[n].z;
        ((real *)&sin)[i] = pose[n].w;
    }
    const real peak = terms[0], twice = 2 * terms[1], per_cell = 1 / resolution;
    lanes total = score.constant_term, total_low = 0;
    lanes sums[9];
    for (int i = 0; i < 9; ++i) sums[i] = 0;
    for (int k = 0; k < readings; ++k) {
        const real2 to = point[k], arm = to + (real2)(mount_x, mount_y);
        const lanes at_x = x + (cos * to.x - sin * to.y), at_y = y + (sin * to.x + cos * to.y);
        ilanes to_col = to_ilanes(at_x), to_row = to_ilanes(at_y);
        to_col += at_x < to_lanes(to_col);
        to_row += at_y < to_lanes(to_row);
        const lanes rest_x = at_x - to_lanes(to_col), rest_y = at_y - to_lanes(to_row);
        const ilanes c = within_lanes(col + to_col, stride - 2), r = within_lanes(row + to_row, last_row);
        const ilanes index = r * stride + c;
        const int *at = (const int *)&index;
        const lanes a = GATHER_AT(lanes, table, at), b = GATHER_AT(lanes, right, at);
        const lanes d = GATHER_AT(lanes, above, at), e = GATHER_AT(lanes, opposite, at);
        const lanes low = a + rest_x * (b - a), high = d + rest_x * (e - d);
        const lanes slope_x = (b - a) + rest_y * ((e - d) - (b - a)), slope_y = high - low;
        const lanes distance = low + rest_y * slope_y;
#if HIT
        const lanes hit = peak * exp(-(distance * (distance * terms[1])));
#else
        const lanes hit = 0;
#endif
        const lanes density = hit + terms[2];
        const lanes term = log(density), sum = total + term, shift = sum - total;
        total_low += (total - (sum - shift)) + (term - shift);
        total = sum;
        const lanes weight = twice * (hit / density), pull = -weight * distance;
        const lanes dx = slope_x * per_cell, dy = slope_y * per_cell;
        const lanes turn = slope_y * (cos * arm.x - sin * arm.y) - slope_x * (sin * arm.x + cos * arm.y);
        sums[0] += pull * dx;
        sums[1] += pull * dy;
        sums[2] += pull * turn;
        sums[3] += weight * dx * dx;
        sums[4] += weight * dx * dy;
        sums[5] += weight * dx * turn;
        sums[6] += weight * dy * dy;
        sums[7] += weight * dy * turn;
        sums[8] += weight * turn * turn;
    }
    for (int i = 0; i < count; ++i) {
        global real *out = gradient + (long)GRADIENT_NUMBERS * (begin + i);
        const real high = ((const real *)&total)[i];
        out[0] = isinf(high) ? high : score.temperature * (high + ((const real *)&total_low)[i]);
        for (int j = 0; j < 9; ++j) out[1 + j] = score.temperature * ((const real *)&sums[j])[i];
    }
}
