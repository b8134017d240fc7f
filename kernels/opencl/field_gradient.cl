// Gradient and Gauss-Newton information of the interpolated likelihood field with respect to the pose; see the
// reference.
// requires: field_term

// Return the share of the hit density in the density at a distance.
real hit_share(const real2 distance, global const FieldTerms *terms) {
    const real2 exponent = field_exponent(distance, terms);
#if LINEAR
#if HIT
    const real hit = terms->hit_peak * exp(-exponent.x) * (1 - exponent.y);
    return hit / (hit + terms->rand_density);
#else
    return 0;
#endif
#else
    const real hit = (terms->hit_peak - exponent.x) + (terms->hit_peak_low - exponent.y);
    return 1 / (1 + exp(terms->rand_density - hit));
#endif
}

// Return the distance at an end point, and its derivatives in x and y, in metres per cell.
real4 distance_slope(global const real *table, const int2 cell, const EndPoint end, const Window window) {
    const real a = table[field_cell(cell.x, cell.y, window)], b = table[field_cell(cell.x + 1, cell.y, window)];
    const real c = table[field_cell(cell.x, cell.y + 1, window)], d = table[field_cell(cell.x + 1, cell.y + 1, window)];
    const real2 distance = bilinear(table, cell, end, window);
    const real x = end.to_next_y.x * (b - a) + end.rest_y.x * (d - c);
    const real y = end.to_next_x.x * (c - a) + end.rest_x.x * (d - b);
    return (real4)(distance.x, distance.y, x, y);
}

// Add the gradient and information of a reading to the sums: slope is the distance, its low part and its derivatives in x
// and y, and arm the end point relative to the robot in the sensor's frame.
void add_slope(real *sums, const real4 slope, const real weight, const real4 at, const real2 arm, const real resolution) {
    const real x = slope.z / resolution, y = slope.w / resolution, pull = -weight * slope.x;
    const real turn = slope.w * (at.z * arm.x - at.w * arm.y) - slope.z * (at.w * arm.x + at.z * arm.y);
    sums[0] += pull * x;
    sums[1] += pull * y;
    sums[2] += pull * turn;
    sums[3] += weight * x * x;
    sums[4] += weight * x * y;
    sums[5] += weight * x * turn;
    sums[6] += weight * y * y;
    sums[7] += weight * y * turn;
    sums[8] += weight * turn * turn;
}

// Add every apart-th reading of a scan from the first to log p and to the sums of add_slope. mount is the sensor's place on
// the robot in cells.
real2 add_readings(const real2 before, real *sums, global const real *table, const int2 origin, const real4 at, const real4 low,
                   global const real2 *point, global const real2 *point_low, global const FieldTerms *terms, const int first,
                   const int size, const int apart, const Window window, const real guard, const real2 mount,
                   const real resolution) {
    real2 total = before;
    for (int k = first; k < size; k += apart) {
        const real2 to = point[k];
#if ALL_READINGS
        if (!isfinite(to.x)) {
            if (isinf(to.x)) total = add_term(total, terms->z_max);
            continue;
        }
#endif
        const EndPoint end = end_point(at, low, to, point_low[k], (real)0.5, guard);
        const real4 slope = distance_slope(table, origin + end.cell, end, window);
        const real2 distance = (real2)(slope.x, slope.y);
        total = add_term(total, log_field(distance, terms));
        const real bend = shape_weight(field_square(distance, terms).x, terms->shape_power, terms->shape_rate);
        const real weight = 2 * terms->square_scale * hit_share(distance, terms) * bend;
        add_slope(sums, slope, weight, at, to + mount, resolution);
    }
    return total;
}

// Write log p, its gradient (3) and the information (9) of poses in the grid's frame, each times the temperature. One
// work-item takes a particle.
kernel void field_gradient(ARGUMENTS) {
    const int n = get_global_id(0);
    if (n >= particles) return;
#if SCANS
    const int scan = (n + batch.ahead) / batch.per_scan, size = start[scan + 1] - start[scan];
    const real constant_term = constant_terms[scan];
    point += start[scan];
    point_low += start[scan];
#else
    const int size = readings;
    const real constant_term = score.constant_term;
#endif
#if TWO_PART_POINTS
    const real4 low = pose_low[n];
#else
    const real4 low = (real4)(0);
#endif
    real sums[9];
    for (int i = 0; i < 9; ++i) sums[i] = 0;
    const real2 total = add_readings((real2)(constant_term, 0), sums, table, pose_cell[n], pose[n], low, point, point_low,
                                     terms, 0, size, 1, window, guard, (real2)(mount_x, mount_y), resolution);
    global real *out = gradient + (long)GRADIENT_NUMBERS * n;
    out[0] = scaled_sum(total, score.temperature);
    for (int i = 0; i < 6; ++i) out[1 + i] = score.temperature * sums[i];
    // The other rows of the symmetric information matrix.
    out[7] = score.temperature * sums[4];
    out[8] = score.temperature * sums[6];
    out[9] = score.temperature * sums[7];
    out[10] = score.temperature * sums[5];
    out[11] = score.temperature * sums[7];
    out[12] = score.temperature * sums[8];
}
