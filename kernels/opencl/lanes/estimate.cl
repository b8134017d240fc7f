// Sums over a cloud of particles, 8 of them at once: estimate.cl.
// requires: lanes/motion

#define ESTIMATE_SUMS 13
#define RIGHT_ANGLE 1.5707963267948966

// Return the sum of all lanes, one after the other.
double sum_in_order(const doubles a) { return ((((((a.s0 + a.s1) + a.s2) + a.s3) + a.s4) + a.s5) + a.s6) + a.s7; }

// A work-item takes all lanes of a block. Lanes without a particle add zeros.
kernel void sum_poses(ARGUMENTS) {
    const int b = get_global_id(0), begin = b * block;
    if (begin >= particles) return;
    global const double *reference = second_pass ? estimate : poses;
    const double x0 = reference[0], y0 = reference[1], theta0 = reference[2];
    const int end = min(begin + block, particles);
    const choices lane = (choices)(0, 1, 2, 3, 4, 5, 6, 7);
    doubles total[ESTIMATE_SUMS];
    for (int k = 0; k < ESTIMATE_SUMS; k++) total[k] = 0.0;
    for (int n = begin; n < end; n += DOUBLES) {
        const int count = min(DOUBLES, end - n);
        const doubles w = lane < (long)count ? load_doubles(weight, n, count) : (doubles)0.0;
        doubles x, y, theta;
        load_poses(poses, n, count, &x, &y, &theta);
        x -= x0, y -= y0;
        const doubles angle = wrap_once_lanes(theta - theta0);
        doubles cosine, sine;
        cos_sin_lanes(angle, &cosine, &sine);
        const doubles w_x = w * x, w_y = w * y, w_angle = w * angle;
        total[0] += w, total[1] += w_x, total[2] += w_y, total[3] += w * cosine, total[4] += w * sine;
        total[5] += w_angle, total[6] += w_x * x, total[7] += w_x * y, total[8] += w_x * angle;
        total[9] += w_y * y, total[10] += w_y * angle, total[11] += w_angle * angle;
        total[12] += fabs(angle) > RIGHT_ANGLE ? w : (doubles)0.0;
    }
    for (int k = 0; k < ESTIMATE_SUMS; k++) sums[(long)b * ESTIMATE_SUMS + k] = sum_in_order(total[k]);
}
