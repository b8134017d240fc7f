// Sums over a cloud of particles, 8 of them at once: estimate.cl.
// requires: lanes/motion

// in lanes: RIGHT_ANGLE add_pose

// Return the sum of all lanes, one after the other.
double sum_in_order(const doubles a) { return ((((((a.s0 + a.s1) + a.s2) + a.s3) + a.s4) + a.s5) + a.s6) + a.s7; }

// A work-item takes all lanes of a block. Lanes without a particle add zeros.
kernel void sum_poses(ARGUMENTS) {
    const int b = get_global_id(0), begin = b * block;
    if (begin >= particles) return;
    global const double *reference = second_pass ? estimate : poses;
    const double x0 = reference[0], y0 = reference[1], theta0 = reference[2];
    const double far = second_pass ? FAR * FAR : INFINITY, turn = second_pass ? FAR_TURN : RIGHT_ANGLE;
    const int end = min(begin + block, particles);
    const choices lane = (choices)(0, 1, 2, 3, 4, 5, 6, 7);
    doubles total[ESTIMATE_SUMS];
    for (int k = 0; k < ESTIMATE_SUMS; k++) total[k] = 0.0;
    for (int n = begin; n < end; n += DOUBLES) {
        const int count = min(DOUBLES, end - n);
        const doubles w = lane < (long)count ? load_doubles(weight, n, count) : (doubles)0.0;
        doubles x, y, theta;
        load_poses(poses, n, count, &x, &y, &theta);
        add_pose_lanes(w, x - x0, y - y0, wrap_once_lanes(theta - theta0), far, turn, total);
    }
    for (int k = 0; k < ESTIMATE_SUMS; k++) sums[(long)b * ESTIMATE_SUMS + k] = sum_in_order(total[k]);
}
