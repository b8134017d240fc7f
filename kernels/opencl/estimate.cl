// Weighted mean, circular in the heading, and covariance of a cloud of particles.
// Sums are relative to a reference pose: the first particle for the mean, and the mean for the covariance (again). Mardia
// and Jupp, "Directional Statistics" (2000), section 2.2. In a block of particles every eighth one belongs to a lane; the
// lanes are summed in the order of their particles, and then added one after the other.
// requires: motion

#define ESTIMATE_SUMS 13
#define ESTIMATE_LANES 8

// Sum weights, offsets, products of offsets, cosines and sines of a block, and find its heaviest particle: one work-item
// takes a block.
kernel void sum_poses(global const double *poses, global const double *weight, global const double *estimate,
                      global double *sums, const int particles, const int block, const int again) {
    const int b = get_global_id(0), begin = b * block;
    if (begin >= particles) return;
    global const double *reference = again ? estimate : poses;
    const double x0 = reference[0], y0 = reference[1], theta0 = reference[2];
    const int end = min(begin + block, particles);
    double total[11], largest = -1.0;
    int best = begin;
    for (int k = 0; k < 11; k++) total[k] = 0.0;
    for (int lane = 0; lane < ESTIMATE_LANES; lane++) {
        double part[11];
        for (int k = 0; k < 11; k++) part[k] = 0.0;
        for (int n = begin + lane; n < end; n += ESTIMATE_LANES) {
            const double w = weight[n], x = poses[3 * (long)n] - x0, y = poses[3 * (long)n + 1] - y0;
            const double angle = wrap_once(poses[3 * (long)n + 2] - theta0);
            const double2 heading = cos_sin(angle);
            part[0] += w, part[1] += w * x, part[2] += w * y;
            part[3] += w * heading.x, part[4] += w * heading.y;
            part[5] += w * x * x, part[6] += w * x * y, part[7] += w * x * angle;
            part[8] += w * y * y, part[9] += w * y * angle, part[10] += w * angle * angle;
            const int heavier = w > largest || (w == largest && n < best);
            best = heavier ? n : best;
            largest = heavier ? w : largest;
        }
        for (int k = 0; k < 11; k++) total[k] += part[k];
    }
    global double *row = sums + (long)b * ESTIMATE_SUMS;
    for (int k = 0; k < 11; k++) row[k] = total[k];
    row[11] = largest, row[12] = (double)best;
}

// Add up each fan rows of sums, one after the other, and find the heaviest particle: one work-item takes a column of a
// group of rows, and the last but one the last two.
kernel void join_poses(global const double *sums, global double *joined, const int rows, const int fan) {
    const int i = get_global_id(0), g = i / ESTIMATE_SUMS, column = i % ESTIMATE_SUMS, begin = g * fan;
    const int end = min(begin + fan, rows);
    if (begin >= rows || column == 12) return;
    double total = 0.0, largest = -1.0, best = 0.0;
    for (int b = begin; b < end; b++) {
        global const double *row = sums + (long)b * ESTIMATE_SUMS;
        const double value = row[column], index = row[12];
        total += value;
        best = value > largest ? index : best;
        largest = value > largest ? value : largest;
    }
    joined[i] = column == 11 ? largest : total;
    if (column == 11) joined[i + 1] = best;
}

// Write the mean pose, or the covariance about it, from the sums of all particles: one work-item takes all.
kernel void finish_estimate(global const double *poses, global const double *sums, global double *estimate,
                            const int again) {
    if (get_global_id(0) > 0) return;
    const double weight = sums[0] > 0.0 ? sums[0] : 1.0;
    const double x = sums[1] / weight, y = sums[2] / weight;
    if (!again) {
        estimate[0] = poses[0] + x, estimate[1] = poses[1] + y;
        estimate[2] = wrap_once(poses[2] + angle_of(sums[3], sums[4]));
        estimate[9] = weight, estimate[10] = sums[12];
        return;
    }
    estimate[3] = sums[5] / weight - x * x, estimate[4] = sums[6] / weight - x * y;
    estimate[5] = sums[7] / weight, estimate[6] = sums[8] / weight - y * y;
    estimate[7] = sums[9] / weight, estimate[8] = sums[10] / weight;
}

// Divide weights by their sum, which the estimate holds: one work-item takes a particle.
kernel void normalize_weights(global const double *weight, global const double *estimate, global double *share,
                              const int particles) {
    const int n = get_global_id(0);
    if (n < particles) share[n] = weight[n] / estimate[9];
}
