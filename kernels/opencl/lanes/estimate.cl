// Sums over a cloud of particles, 8 of them at once: estimate.cl.
// requires: lanes/motion

#define ESTIMATE_SUMS 13

// A work-item takes a block. Terms are computed in lanes, and added in the order of the particles.
kernel void sum_poses(global const double *poses, global const double *weight, global const double *estimate,
                      global double *sums, const int particles, const int block, const int again) {
    const int b = get_global_id(0), begin = b * block;
    if (begin >= particles) return;
    global const double *reference = again ? estimate : poses;
    const double x0 = reference[0], y0 = reference[1], theta0 = reference[2];
    const int end = min(begin + block, particles);
    // A vector of sums: the terms of a particle are added at once.
    double16 total = 0.0;
    double largest = -1.0;
    int best = begin;
    for (int n = begin; n < end; n += DOUBLES) {
        const int count = min(DOUBLES, end - n);
        const long place = 3 * (long)n;
        const doubles w = load_doubles(weight, n, 1, count);
        const doubles x = load_doubles(poses, place, 3, count) - x0, y = load_doubles(poses, place + 1, 3, count) - y0;
        const doubles angle = wrap_once_lanes(load_doubles(poses, place + 2, 3, count) - theta0);
        doubles cosine, sine;
        cos_sin_lanes(angle, &cosine, &sine);
        const doubles w_x = w * x, w_y = w * y;
        doubles terms[11] = {w, w_x, w_y, w * cosine, w * sine, w_x * x, w_x * y, w_x * angle, w_y * y, w_y * angle,
                             w * angle * angle};
        const double *term = (const double *)terms;
        for (int i = 0; i < count; i++) {
            total += (double16)(term[i], term[8 + i], term[16 + i], term[24 + i], term[32 + i], term[40 + i], term[48 + i],
                                term[56 + i], term[64 + i], term[72 + i], term[80 + i], 0, 0, 0, 0, 0);
            best = term[i] > largest ? n + i : best;
            largest = term[i] > largest ? term[i] : largest;
        }
    }
    global double *row = sums + (long)b * ESTIMATE_SUMS;
    for (int k = 0; k < 11; k++) row[k] = ((const double *)&total)[k];
    row[11] = largest, row[12] = (double)best;
}
