// Weighted mean, circular in the heading, and covariance of a cloud of particles; see the reference.
// requires: motion

#define RIGHT_ANGLE 1.5707963267948966

// Add a particle's weight, offset and turn to the sums; the last sum is of weights beyond a squared distance or a turn.
void add_pose(const double w, const double x, const double y, const double angle, const double far, const double turn,
              double *part) {
    const double2 heading = cos_sin(angle);
    const double w_x = w * x, w_y = w * y, w_angle = w * angle;
    part[0] += w, part[1] += w_x, part[2] += w_y;
    part[3] += w * heading.x, part[4] += w * heading.y, part[5] += w_angle;
    part[6] += w_x * x, part[7] += w_x * y, part[8] += w_x * angle;
    part[9] += w_y * y, part[10] += w_y * angle, part[11] += w_angle * angle;
    part[12] += x * x + y * y > far || fabs(angle) > turn ? w : 0.0;
}

// Sum weights, offsets, cosines and sines, products of offsets, and the weights of far headings, or in the second pass of
// far poses: one work-item takes a number of lanes of a block.
kernel void sum_poses(ARGUMENTS) {
    const int i = get_global_id(0), each = ESTIMATE_LANES / lanes, begin = i / each * block, first = i % each * lanes;
    if (begin >= particles) return;
    global const double *reference = second_pass ? estimate : poses;
    const double x0 = reference[0], y0 = reference[1], theta0 = reference[2];
    const double far = second_pass ? FAR * FAR : INFINITY, turn = second_pass ? FAR_TURN : RIGHT_ANGLE;
    const int end = min(begin + block, particles);
    double total[ESTIMATE_SUMS];
    for (int k = 0; k < ESTIMATE_SUMS; k++) total[k] = 0.0;
    for (int lane = first; lane < first + lanes; lane++) {
        double part[ESTIMATE_SUMS];
        for (int k = 0; k < ESTIMATE_SUMS; k++) part[k] = 0.0;
        for (int n = begin + lane; n < end; n += ESTIMATE_LANES) {
            const double w = weight[n], x = poses[3 * (long)n] - x0, y = poses[3 * (long)n + 1] - y0;
            add_pose(w, x, y, wrap_once(poses[3 * (long)n + 2] - theta0), far, turn, part);
        }
        for (int k = 0; k < ESTIMATE_SUMS; k++) total[k] += part[k];
    }
    for (int k = 0; k < ESTIMATE_SUMS; k++) sums[(long)i * ESTIMATE_SUMS + k] = total[k];
}

// Write the mean pose and the covariance about it from the sums of all groups, and whether headings require a second
// pass; that pass writes the covariance, and the share of far poses. One work-item takes all.
kernel void finish_estimate(ARGUMENTS) {
    if (get_global_id(0) > 0) return;
    double total[ESTIMATE_SUMS];
    for (int k = 0; k < ESTIMATE_SUMS; k++) total[k] = 0.0;
    for (int g = 0; g < groups; g++) {
        for (int k = 0; k < ESTIMATE_SUMS; k++) total[k] += sums[(long)g * ESTIMATE_SUMS + k];
    }
    const double weight = total[0] > 0.0 ? total[0] : 1.0;
    const double x = total[1] / weight, y = total[2] / weight, angle = total[5] / weight;
    const double mean = second_pass ? 0.0 : angle_of(total[3], total[4]);
    if (!second_pass) {
        estimate[0] = poses[0] + x, estimate[1] = poses[1] + y, estimate[2] = wrap_once(poses[2] + mean);
        estimate[9] = weight;
        estimate[WIDE_HEADINGS] = total[12] > 0.0 || fabs(mean) > RIGHT_ANGLE ? 1.0 : 0.0;
    }
    if (second_pass) estimate[FAR_SHARE] = total[12] / weight;
    estimate[3] = total[6] / weight - x * x, estimate[4] = total[7] / weight - x * y;
    estimate[5] = total[8] / weight - x * angle, estimate[6] = total[9] / weight - y * y;
    estimate[7] = total[10] / weight - y * angle, estimate[8] = total[11] / weight - mean * (2.0 * angle - mean);
}

// Divide weights by their sum, which the estimate holds: one work-item takes a particle.
kernel void normalize_weights(ARGUMENTS) {
    const int n = get_global_id(0);
    if (n < particles) share[n] = weight[n] / estimate[9];
}
