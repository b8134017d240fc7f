// Sums over pairs of reading and expected range from which the beam model's parameters are learned (book table 6.2);
// see the reference.
// requires: mixture error_free

#if INFORMATION
#define SUMS 39
#else
#define SUMS 13
#endif

// Return log p(z | z*) and the responsibilities of hit, short and rand, 0 where the density is 0.
real4 responsibilities(const real z, const real expected, global const MixtureTerms *terms,
                       global const real *masses) {
    const real hit = log_hit(z, expected, terms, masses), shorter = log_short(z, expected, terms);
    const real largest = fmax(fmax(hit, shorter), terms->rand_density);
    if (isinf(largest)) return (real4)(largest, 0, 0, 0);
    const real p_hit = exp(hit - largest), p_short = exp(shorter - largest), p_rand = exp(terms->rand_density - largest);
    const real p = p_hit + p_short + p_rand;
    return (real4)(largest + log(p), p_hit / p, p_short / p, p_rand / p);
}

// Return the untruncated density of a hit at a distance of x scales, times sigma.
real hit_phi(const real x, global const MixtureTerms *terms) {
    const real2 t = (real2)((real)0.5 * x * x, 0);
    return terms->unit_peak * exp(-shape_exponent(t, terms->shape_power, terms->shape_rate).x);
}

// W u^2, and the derivatives of log p_hit.
typedef struct {
    real square, h_s, h_m, h_ss, h_sm, h_mm;
} HitSlopes;

// Return the derivatives of log p_hit of a pair.
HitSlopes hit_slopes(const real z, const real expected, global const MixtureTerms *terms, global const real *masses) {
    const real mean = mean_range(expected, terms), above = above_mean(expected, terms);
    const real u = hit_offset(z, expected, terms).x * terms->inverse_sigma;
    const real x_0 = mean * terms->inverse_sigma, x_1 = above * terms->inverse_sigma;
    const real weight = shape_weight((real)0.5 * u * u, terms->shape_power, terms->shape_rate), pull = weight * u;
    const real square = pull * u;
    real t = 0, p = 0, v = 0, q = 0, w = 0;
    const real mass = mass_within(mean, above, terms->erf_scale, terms, masses);
    if (mass < 1) {
        const real phi_0 = hit_phi(x_0, terms) / mass, phi_1 = hit_phi(x_1, terms) / mass;
        const real pull_0 = shape_weight((real)0.5 * x_0 * x_0, terms->shape_power, terms->shape_rate) * x_0 * phi_0;
        const real pull_1 = shape_weight((real)0.5 * x_1 * x_1, terms->shape_power, terms->shape_rate) * x_1 * phi_1;
        t = x_0 * phi_0 + x_1 * phi_1;
        p = phi_1 - phi_0;
        v = pull_0 + pull_1;
        q = x_1 * pull_1 - x_0 * pull_0 + p * t;
        w = x_0 * x_0 * pull_0 + x_1 * x_1 * pull_1;
    }
    const real bend = shape_bend(square, terms->shape_power);
    const real h_s = square - 1 + t, h_ss = square * (bend - 2) - t + w + t * t;
    // A clamped mean does not move with the bias.
    if (mean != expected + terms->range_bias) return (HitSlopes){square, h_s, 0, h_ss, 0, 0};
    return (HitSlopes){square, h_s, pull + p, h_ss, pull * (bend - 2) - p + q, weight * (bend - 1) + v + p * p};
}

// Return the derivatives s_l and s_ll of log p_short of a pair.
real2 short_slopes(const real z, const real expected, global const MixtureTerms *terms) {
    const real x = terms->lambda_short * expected, f = short_factor(x), v = f - x;
    return (real2)(1 - v - terms->lambda_short * z, v * (f - 1) - terms->lambda_short * z);
}

// Add the terms of a pair to the sums, from responsibilities and slopes. They are log p; r; r_hit h_s, r_hit h_m, r_short s_l; r_hit h_ss, r_hit h_sm,
// r_hit h_mm, r_short s_ll; r_hit W u^2, r_short z. INFORMATION: 1 where rand is the likeliest cause; the upper triangle
// of y y' with y = (r_hit, r_short, r_rand, r_hit h_s, r_hit h_m, r_short s_l); r_hit h_s^2, r_hit h_s h_m, r_hit h_m^2,
// r_short s_l^2.
void add_causes(const real z, const real4 r, const HitSlopes hit, const real2 shorter, real *sums) {
    sums[0] += r.x;
    sums[1] += r.y;
    sums[2] += r.z;
    sums[3] += r.w;
    sums[4] += r.y * hit.h_s;
    sums[5] += r.y * hit.h_m;
    sums[6] += r.z * shorter.x;
    sums[7] += r.y * hit.h_ss;
    sums[8] += r.y * hit.h_sm;
    sums[9] += r.y * hit.h_mm;
    sums[10] += r.z * shorter.y;
    sums[11] += r.y * hit.square;
    sums[12] += r.z * z;
#if INFORMATION
    const real one = 1, none = 0;
    sums[13] += (r.w > r.y) & (r.w > r.z) ? one : none;
    const real y[6] = {r.y, r.z, r.w, r.y * hit.h_s, r.y * hit.h_m, r.z * shorter.x};
    int place = 14;
    for (int i = 0; i < 6; ++i)
        for (int j = i; j < 6; ++j) sums[place++] += y[i] * y[j];
    sums[35] += r.y * hit.h_s * hit.h_s;
    sums[36] += r.y * hit.h_s * hit.h_m;
    sums[37] += r.y * hit.h_m * hit.h_m;
    sums[38] += r.z * shorter.x * shorter.x;
#endif
}

// Add the terms of a pair to the sums.
void add_pair(const real z, const real expected, global const MixtureTerms *terms, global const real *masses,
              real *sums) {
    const real4 r = responsibilities(z, expected, terms, masses);
    HitSlopes hit = {0, 0, 0, 0, 0, 0};
    real2 shorter = (real2)(0);
    if (r.y > 0) hit = hit_slopes(z, expected, terms, masses);
    if (r.z > 0) shorter = short_slopes(z, expected, terms);
    add_causes(z, r, hit, shorter, sums);
}

// Sum over blocks of pairs: one work-item takes a block. Pair k of a block is pair block * across + k * along.
kernel void e_step(ARGUMENTS) {
    const int block = get_global_id(0);
    if (block >= blocks) return;
    real total[SUMS], total_low[SUMS], part[SUMS];
    for (int j = 0; j < SUMS; ++j) total[j] = total_low[j] = 0;
    for (int first = 0; first < readings; first += BLOCK_TERMS) {
        const int last = min(first + BLOCK_TERMS, readings);
        for (int j = 0; j < SUMS; ++j) part[j] = 0;
        for (int k = first; k < last; ++k) {
            const long n = (long)block * across + (long)k * along;
            if (!isnan(reading[n])) add_pair(reading[n], expected[n], terms, masses, part);
        }
        for (int j = 0; j < SUMS; ++j) {
            const real2 sum = add_term((real2)(total[j], total_low[j]), part[j]);
            total[j] = sum.x;
            total_low[j] = sum.y;
        }
    }
    for (int j = 0; j < SUMS; ++j) sums[(long)block * width + j] = total[j] + total_low[j];
}

// Write log p and the responsibilities of each pair, NaN for padding. One work-item takes a block of pairs.
kernel void pair_causes(ARGUMENTS) {
    const int block = get_global_id(0);
    if (block >= blocks) return;
    for (int k = 0; k < readings; ++k) {
        const long n = (long)block * across + (long)k * along;
        causes[n] = isnan(reading[n]) ? (real4)(NAN) : responsibilities(reading[n], expected[n], terms, masses);
    }
}
