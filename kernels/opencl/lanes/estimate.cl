// Sums over a cloud of particles, 8 of them at once: estimate.cl.
// requires: lanes/motion

#define ESTIMATE_SUMS 13

// Return the sum of all lanes, one after the other.
double sum_in_order(const doubles a) { return ((((((a.s0 + a.s1) + a.s2) + a.s3) + a.s4) + a.s5) + a.s6) + a.s7; }

// A work-item takes a block. Lanes without a particle add zeros.
kernel void sum_poses(global const double *poses, global const double *weight, global const double *estimate,
                      global double *sums, const int particles, const int block, const int again) {
    const int b = get_global_id(0), begin = b * block;
    if (begin >= particles) return;
    global const double *reference = again ? estimate : poses;
    const double x0 = reference[0], y0 = reference[1], theta0 = reference[2];
    const int end = min(begin + block, particles);
    const choices lane = (choices)(0, 1, 2, 3, 4, 5, 6, 7);
    doubles total[11], largest = -1.0;
    choices best = begin;
    for (int k = 0; k < 11; k++) total[k] = 0.0;
    for (int n = begin; n < end; n += DOUBLES) {
        const int count = min(DOUBLES, end - n);
        const choices there = lane < (long)count;
        const doubles w = there ? load_doubles(weight, n, count) : (doubles)0.0;
        doubles x, y, theta;
        load_poses(poses, n, count, &x, &y, &theta);
        x -= x0, y -= y0;
        const doubles angle = wrap_once_lanes(theta - theta0);
        doubles cosine, sine;
        cos_sin_lanes(angle, &cosine, &sine);
        const doubles w_x = w * x, w_y = w * y;
        total[0] += w, total[1] += w_x, total[2] += w_y, total[3] += w * cosine, total[4] += w * sine;
        total[5] += w_x * x, total[6] += w_x * y, total[7] += w_x * angle;
        total[8] += w_y * y, total[9] += w_y * angle, total[10] += w * angle * angle;
        const choices heavier = there & (w > largest);
        best = heavier ? n + lane : best;
        largest = heavier ? w : largest;
    }
    global double *row = sums + (long)b * ESTIMATE_SUMS;
    for (int k = 0; k < 11; k++) row[k] = sum_in_order(total[k]);
    double heaviest = -1.0;
    int first = begin;
    for (int i = 0; i < DOUBLES; i++) {
        const double w = ((const double *)&largest)[i];
        const int n = (int)((const long *)&best)[i], heavier = w > heaviest || (w == heaviest && n < first);
        first = heavier ? n : first;
        heaviest = heavier ? w : heaviest;
    }
    row[11] = heaviest, row[12] = (double)first;
}
