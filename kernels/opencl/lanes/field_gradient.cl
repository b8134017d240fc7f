// Gradient and information of LANES particles at once: field_gradient of field_gradient.cl. End points are rounded to
// the working precision: the interpolated distance is continuous, so it changes by no more than the end point's error.
// requires: lanes/end_point lanes/math lanes/hit_shape

// Densities whose product is taken before the logarithm (a power of 2), if all are within these bounds.
#define TOGETHER 4
#define LEAST_DENSITY 1e-9f
#define LARGEST_DENSITY 1e9f

// A work-item takes LANES particles of one scan.
kernel void field_gradient(ARGUMENTS) {
    const int item = get_global_id(0);
#if SCANS
    // No work-item has particles of two scans.
    const int items = (batch.per_scan + LANES - 1) / LANES, scan = item / items;
    const int begin = scan * batch.per_scan + LANES * (item % items);
    if (begin >= particles) return;
    const int left = (scan + 1) * batch.per_scan - begin, size = start[scan + 1] - start[scan];
    const real constant_term = constant_terms[scan];
    point += start[scan];
#else
    const int begin = LANES * item, left = particles - begin, size = readings;
    if (left <= 0) return;
    const real constant_term = score.constant_term;
#endif
    const int count = left < LANES ? left : LANES;
    const int stride = window.cols + 2 * FIELD_RING, last_row = window.rows + 2 * FIELD_RING - 2;
    Particles some;
    for (int i = 0; i < LANES; ++i) {
        const int n = begin + (i < count ? i : count - 1);
        // Half a cell less: interpolation is between centres.
        set_particle(&some, i, pose_cell[n], pose[n], 0.5f, 1);
        ((real *)&some.x)[i] += pose_low[n].x, ((real *)&some.y)[i] += pose_low[n].y;
    }
    const ilanes col = some.col, row = some.row;
    const lanes x = some.x, y = some.y, cos = some.cos, sin = some.sin;
    const real peak = terms->hit_peak, twice = 2 * terms->square_scale;
    const real power = terms->shape_power, rate = terms->shape_rate;
    // The sensor's place on the robot, turned.
    const lanes mounted_x = cos * mount_x - sin * mount_y, mounted_y = sin * mount_x + cos * mount_y;
    LanePair total = {constant_term, 0};
    lanes product = 1;
    const int mask = peak + terms->rand_density < LARGEST_DENSITY && terms->rand_density > LEAST_DENSITY ? TOGETHER - 1 : 0;
    lanes sums[9];
    for (int i = 0; i < 9; ++i) sums[i] = 0;
    for (int k = 0; k < size; ++k) {
        const real2 to = point[k];
        const lanes arm_x = cos * to.x - sin * to.y, arm_y = sin * to.x + cos * to.y;
        const lanes at_x = x + arm_x, at_y = y + arm_y;
        const ilanes to_col = floor_int_lanes(at_x), to_row = floor_int_lanes(at_y);
        const lanes rest_x = at_x - to_lanes(to_col), rest_y = at_y - to_lanes(to_row);
        const ilanes c = within_lanes(col + to_col, stride - 2), r = within_lanes(row + to_row, last_row);
        const ilanes index = r * stride + c;
        const int *at = (const int *)&index;
        lanes a, b, d, e;
        gather_pairs(table, at, &a, &b);
        gather_pairs(table + stride, at, &d, &e);
        const lanes low = a + rest_x * (b - a), high = d + rest_x * (e - d);
        const lanes slope_x = (b - a) + rest_y * ((e - d) - (b - a)), slope_y = high - low;
        const lanes distance = low + rest_y * slope_y;
        const lanes square = distance * (distance * terms->square_scale);
#if HIT
        const lanes hit = peak * exp_lanes(-shape_exponent_lanes((LanePair){square, 0}, power, rate).x);
#else
        const lanes hit = 0;
#endif
        const lanes density = hit + terms->rand_density;
        product *= density;
        if ((k & mask) == mask || k == size - 1) {
            total = add_term_lanes(total, log_lanes(product));
            product = 1;
        }
        const lanes weight = twice * (hit / density) * shape_weight_lanes(square, power, rate), pull = weight * distance;
        const lanes turn = slope_y * (arm_x + mounted_x) - slope_x * (arm_y + mounted_y);
        const lanes by_x = weight * slope_x, by_y = weight * slope_y;
        sums[0] -= pull * slope_x;
        sums[1] -= pull * slope_y;
        sums[2] -= pull * turn;
        sums[3] += by_x * slope_x;
        sums[4] += by_x * slope_y;
        sums[5] += by_x * turn;
        sums[6] += by_y * slope_y;
        sums[7] += by_y * turn;
        sums[8] += weight * turn * turn;
    }
    // Slopes in x and y were per cell.
    const real one = score.temperature, cell = one / resolution, square = cell / resolution;
    const real scale[9] = {cell, cell, one, square, square, cell, square, cell, one};
    const int entry[12] = {0, 1, 2, 3, 4, 5, 4, 6, 7, 5, 7, 8};
    const lanes log_p = scaled_sum_lanes(total, score.temperature);
    for (int i = 0; i < count; ++i) {
        global real *out = gradient + (long)GRADIENT_NUMBERS * (begin + i);
        out[0] = ((const real *)&log_p)[i];
        for (int j = 0; j < 12; ++j) out[1 + j] = scale[entry[j]] * ((const real *)&sums[entry[j]])[i];
    }
}
