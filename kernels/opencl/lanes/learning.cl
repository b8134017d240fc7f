// Sums over pairs of reading and expected range, LANES pairs at once: learning.cl with a pair in every lane. Its header
// has the formulas. exp, log, tanh and erf are PoCL's own functions of vectors, which cost far less per number than its
// scalar ones.
// requires: mixture error_free lanes/types

#define ROOT_2PI ((real)2.5066282746310002)
#if INFORMATION
#define SUMS 40
#else
#define SUMS 14
#endif

// Return the mean of p_hit.
lanes hit_mean_lanes(const lanes expected, global const real *terms) {
    const lanes mean = expected + terms[10], lower = mean > terms[6] ? (lanes)terms[6] : mean;
    return lower < 0 ? (lanes)0 : lower;
}

// Return the mass of the normal around the mean on [0, range_max].
lanes hit_mass_lanes(const lanes mean, const real erf_scale, const real range_max) {
    const lanes below = mean * erf_scale, above = (range_max - mean) * erf_scale;
    const lanes nearer = below < above ? below : above, farther = below < above ? above : below;
    if (!any_lane(nearer <= ERF_ONE)) return (lanes)1;
    const lanes rest = any_lane(farther <= ERF_ONE) ? erf(farther) : (lanes)1;
    return nearer > ERF_ONE ? (lanes)1 : (real)0.5 * (nearer > 0 ? erf(nearer) + rest : rest);
}

// Return x / (1 - exp(-x)) for x >= 0.
lanes short_factor_lanes(const lanes x) {
    const lanes h = (real)0.5 * x;
    return h > TINY_DECAY ? h / tanh(h) + h : (lanes)1;
}

// Add the terms of a pair in each lane to the sums of the lane.
void add_pair_lanes(const lanes reading, const lanes expected_range, global const real *terms, lanes *sums) {
    // Padding has no weight; a pair of zeros stands in for it.
    const ilanes known = reading == reading;
    const lanes z = known ? reading : (lanes)0, expected = known ? expected_range : (lanes)0;

    const lanes mean = hit_mean_lanes(expected, terms), mass = hit_mass_lanes(mean, terms[2],
                                                                              terms[6]), off_mean = z - mean;
    const lanes f = short_factor_lanes(terms[4] * expected);
    lanes hit = terms[0] - off_mean * (off_mean * terms[1]) + terms[8];
    const ilanes cut = mass < 1;
    if (any_lane(cut)) hit -= cut ? log(mass) : (lanes)0;
    const lanes length = expected > 0 ? expected : (lanes)1;
    lanes shorter = terms[3] + log(f) - log(length) - terms[4] * z;
    shorter = (z <= expected) & (expected > 0) ? shorter : (lanes)-INFINITY;
    lanes largest = hit > shorter ? hit : shorter;
    largest = largest > terms[5] ? largest : (lanes)terms[5];
    const ilanes possible = largest > -INFINITY;
    const lanes shift = possible ? largest : (lanes)0;
    lanes r_hit = exp(hit - shift), r_short = exp(shorter - shift), r_rand = exp(terms[5] - shift);
    const lanes p = possible ? r_hit + r_short + r_rand : (lanes)1;
    const lanes part = known ? 1 / p : (lanes)0;
    r_hit *= part;
    r_short *= part;
    r_rand *= part;

    const lanes u = off_mean * terms[11], square = u * u;
    lanes t = 0, q = 0, w = 0, slope = 0;
    if (any_lane(cut)) {
        const lanes x_0 = mean * terms[11], x_1 = (terms[6] - mean) * terms[11];
        const lanes phi_0 = cut ? exp((real)-0.5 * x_0 * x_0) / (ROOT_2PI * mass) : (lanes)0;
        const lanes phi_1 = cut ? exp((real)-0.5 * x_1 * x_1) / (ROOT_2PI * mass) : (lanes)0;
        t = x_0 * phi_0 + x_1 * phi_1;
        slope = phi_1 - phi_0;
        q = x_1 * x_1 * phi_1 - x_0 * x_0 * phi_0 + slope * t;
        w = x_0 * x_0 * x_0 * phi_0 + x_1 * x_1 * x_1 * phi_1;
    }
    // A mean that is clamped does not move with the bias.
    const lanes moved = mean == expected + terms[10] ? r_hit : (lanes)0;
    // Terms of a cause that is impossible may be infinite.
    const ilanes is_hit = r_hit > 0, is_short = r_short > 0;
    const lanes h_s = is_hit ? square - 1 + t : (lanes)0, h_m = moved > 0 ? u + slope : (lanes)0;
    const lanes v = f - terms[4] * expected;
    const lanes s_l = is_short ? 1 - v - terms[4] * z : (lanes)0;
    const lanes off = z - expected;
    sums[0] += known ? largest + log(p) : (lanes)0;
    sums[1] += r_hit;
    sums[2] += r_short;
    sums[3] += r_rand;
    sums[4] += r_hit * h_s;
    sums[5] += r_hit * h_m;
    sums[6] += r_short * s_l;
    sums[7] += is_hit ? r_hit * (-2 * square - t + w + t * t) : (lanes)0;
    sums[8] += moved > 0 ? moved * (-2 * u - slope + q) : (lanes)0;
    sums[9] += moved > 0 ? moved * (-1 + t + slope * slope) : (lanes)0;
    sums[10] += is_short ? r_short * (v * (f - 1) - terms[4] * z) : (lanes)0;
    sums[11] += r_hit * off * off;
    sums[12] += r_hit * off;
    sums[13] += r_short * z;
#if INFORMATION
    sums[14] += (r_rand > r_hit) & (r_rand > r_short) ? (lanes)1 : (lanes)0;
    const lanes y[6] = {r_hit, r_short, r_rand, r_hit * h_s, r_hit * h_m, r_short * s_l};
    int place = 15;
    for (int i = 0; i < 6; ++i)
        for (int j = i; j < 6; ++j) sums[place++] += y[i] * y[j];
    sums[36] += r_hit * h_s * h_s;
    sums[37] += r_hit * h_s * h_m;
    sums[38] += r_hit * h_m * h_m;
    sums[39] += r_short * s_l * s_l;
#endif
}

// Sum over blocks of pairs: one work-item takes a block, whose pairs are contiguous (along is 1) and fill all lanes.
kernel void e_step(ARGUMENTS) {
    const int block = get_global_id(0);
    if (block >= blocks) return;
    global const real *z = reading + (long)block * across, *z_star = expected + (long)block * across;
    real total[SUMS], total_low[SUMS];
    lanes part[SUMS];
    for (int j = 0; j < SUMS; ++j) total[j] = total_low[j] = 0;
    for (int first = 0; first < readings; first += BLOCK_TERMS * LANES) {
        const int last = min(first + BLOCK_TERMS * LANES, readings);
        for (int j = 0; j < SUMS; ++j) part[j] = 0;
        for (int k = first; k < last; k += LANES)
            add_pair_lanes(load_lanes(0, z + k), load_lanes(0, z_star + k), terms, part);
        for (int j = 0; j < SUMS; ++j) {
            const real2 sum = add_term((real2)(total[j], total_low[j]), sum_lanes(part[j]));
            total[j] = sum.x;
            total_low[j] = sum.y;
        }
    }
    for (int j = 0; j < SUMS; ++j) sums[(long)block * width + j] = total[j] + total_low[j];
}
