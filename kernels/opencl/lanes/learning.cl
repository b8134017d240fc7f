// Sums over pairs of reading and expected range, LANES pairs at once: learning.cl with a pair in every lane. Its header
// has the formulas.
// requires: error_free lanes/mixture

#if INFORMATION
#define SUMS 39
#else
#define SUMS 13
#endif

// in lanes: hit_phi HitSlopes add_causes

// Add the terms of a pair in each lane to the sums of the lane.
void add_pair_lanes(const lanes reading, const lanes expected_range, global const MixtureTerms *terms,
                    global const real *masses, lanes *sums) {
    // Padding has no weight and is read as a pair of zeros.
    const ilanes known = reading == reading;
    const lanes z = known ? reading : (lanes)0, expected = known ? expected_range : (lanes)0;

    const real power = terms->shape_power, rate = terms->shape_rate;
    int any_clamped, within;
    const lanes mean = mean_range_lanes(expected, terms, 0, &any_clamped);
    const lanes above = above_mean_lanes(expected, any_clamped, terms, 0);
    const lanes mass = mass_within_lanes(mean, above, terms->erf_scale, terms, masses, 0, &within);
    const lanes off = z - mean;
    const LanePair exponent = shape_exponent_lanes((LanePair){off * (off * terms->square_scale), 0}, power, rate);
    lanes hit = terms->hit_peak - exponent.x + (terms->hit_peak_low - exponent.y);
    if (!within) hit -= log_lanes(mass);
    const lanes length = short_length_lanes(expected, terms, 0);
    lanes shorter = terms->z_short - log_lanes(length) - terms->lambda_short * z;
    shorter = (z <= expected) & (expected > 0) ? shorter : (lanes)-INFINITY;
    const lanes largest = larger_lanes(larger_lanes(hit, shorter), (lanes)terms->rand_density);
    const ilanes possible = largest > -INFINITY;
    const lanes shift = possible ? largest : (lanes)0;
    lanes r_hit = exp_lanes(hit - shift), r_short = exp_lanes(shorter - shift), r_rand = exp_lanes(terms->rand_density - shift);
    const lanes p = possible ? r_hit + r_short + r_rand : (lanes)1;
    const lanes part = known ? 1 / p : (lanes)0;
    r_hit *= part;
    r_short *= part;
    r_rand *= part;

    const lanes u = off * terms->inverse_sigma;
    const lanes weight = shape_weight_lanes((real)0.5 * u * u, power, rate), pull = weight * u;
    const lanes square = pull * u;
    lanes t = 0, v = 0, q = 0, w = 0, slope = 0;
    if (!within) {
        const lanes x_0 = mean * terms->inverse_sigma, x_1 = above * terms->inverse_sigma;
        const lanes phi_0 = hit_phi_lanes(x_0, terms) / mass, phi_1 = hit_phi_lanes(x_1, terms) / mass;
        const lanes pull_0 = shape_weight_lanes((real)0.5 * x_0 * x_0, power, rate) * x_0 * phi_0;
        const lanes pull_1 = shape_weight_lanes((real)0.5 * x_1 * x_1, power, rate) * x_1 * phi_1;
        t = x_0 * phi_0 + x_1 * phi_1;
        slope = phi_1 - phi_0;
        v = pull_0 + pull_1;
        q = x_1 * pull_1 - x_0 * pull_0 + slope * t;
        w = x_0 * x_0 * pull_0 + x_1 * x_1 * pull_1;
    }
    const lanes bend = shape_bend_lanes(square, power);
    // Terms of a cause that is impossible may be infinite.
    const ilanes is_hit = r_hit > 0, is_short = r_short > 0;
#if BIAS
    // A clamped mean does not move with the bias.
    const ilanes moved = is_hit & ~is_clamped_lanes(mean, expected, terms, 0);
#else
    const ilanes moved = is_hit;
#endif
    const HitSlopes_lanes slopes = {is_hit ? square : (lanes)0,
                                    is_hit ? square - 1 + t : (lanes)0,
                                    moved ? pull + slope : (lanes)0,
                                    is_hit ? square * (bend - 2) - t + w + t * t : (lanes)0,
                                    moved ? pull * (bend - 2) - slope + q : (lanes)0,
                                    moved ? weight * (bend - 1) + v + slope * slope : (lanes)0};
    const lanes x = terms->lambda_short * expected, f = expected > SMALLEST_RANGE ? expected / length : (lanes)1;
    const lanes left = f - x, decay = terms->lambda_short * z;
    const LanePair short_slopes = {is_short ? 1 - left - decay : (lanes)0, is_short ? left * (f - 1) - decay : (lanes)0};
    const lanes log_p = known ? largest + log_lanes(p) : (lanes)0;
    add_causes_lanes(z, (LaneQuad){log_p, r_hit, r_short, r_rand}, slopes, short_slopes, sums);
}

// Sum over blocks of pairs: one work-item takes a block of contiguous pairs (along is 1) that fill all lanes.
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
            add_pair_lanes(load_lanes(0, z + k), load_lanes(0, z_star + k), terms, masses, part);
        for (int j = 0; j < SUMS; ++j) {
            const real2 sum = add_term((real2)(total[j], total_low[j]), sum_lanes(part[j]));
            total[j] = sum.x;
            total_low[j] = sum.y;
        }
    }
    for (int j = 0; j < SUMS; ++j) sums[(long)block * width + j] = total[j] + total_low[j];
}
