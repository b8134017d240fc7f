// Beam mixture density of LANES readings at once: mixture.cl in lanes.
// requires: error_free mixture lanes/error_free lanes/math lanes/hit_shape

// Up to this 1 - exp(-x) is x within a quarter of the last bit.
#if FLOAT64
#define SMALL_DECAY 5.55e-17
#else
#define SMALL_DECAY 2.98023224e-08f
#endif
// Numbers of a bin of angles of incidence, and a field of the terms; a bin's terms begin bin_at numbers later.
#define MIXTURE_TERMS ((int)(sizeof(MixtureTerms) / sizeof(real)))
#if INCIDENCE
#define TERM(field) GATHER(lanes, (&terms->field), bin_at)
#else
#define TERM(field) terms->field
#endif

// Return the larger numbers.
lanes larger_lanes(const lanes a, const lanes b) { return a > b ? a : b; }

#define NOT_INLINE __attribute__((noinline))

#if STOPS
// in lanes: last_range
#endif

#if HIT
#if BIAS
// Return ranges clamped to [0, most].
lanes clamped_lanes(const lanes range, const real most) {
    const lanes raised = range < 0 ? (lanes)0 : range;
    return raised > most ? (lanes)most : raised;
}
#endif

// Return the means of p_hit; any_clamped becomes whether one is at an end of the range.
INLINE lanes mean_range_lanes(const lanes expected, global const MixtureTerms *terms, const ilanes bin_at, int *any_clamped) {
    *any_clamped = 0;
#if BIAS
    const lanes wanted = expected + TERM(range_bias);
    *any_clamped = any_lane((wanted < 0) | (wanted >= terms->range_max));
    return *any_clamped ? clamped_lanes(wanted, terms->range_max) : wanted;
#else
    return expected;
#endif
}

INLINE lanes above_mean_lanes(const lanes expected, const int any_clamped, global const MixtureTerms *terms, const ilanes bin_at) {
#if BIAS
    const LanePair last = two_sum_lanes((lanes)terms->range_max, -(lanes)(TERM(range_bias)));
    const lanes above = (last.x - expected) + (last.y - TERM(range_bias_low));
    return any_clamped ? clamped_lanes(above, terms->range_max) : above;
#else
    return terms->range_max - expected;
#endif
}

#if BIAS
// Return whether means are at an end of the range.
ilanes is_clamped_lanes(const lanes mean, const lanes expected, global const MixtureTerms *terms, const ilanes bin_at) {
    return mean != expected + TERM(range_bias);
}
#endif

LanePair hit_scale_lanes(const lanes expected, global const MixtureTerms *terms, const ilanes bin_at) {
#if GROWTH
#if EXACT_EXPONENT
    const lanes growth = TERM(relative_growth), sum = multiply_add_lanes(growth, expected, (lanes)1), scale = 1 / sum;
    // Rounding error of the sum; below 2^24 the sum less 1 is exact.
    const lanes excess = multiply_add_lanes(-TERM(relative_growth_low), expected, rest_of_lanes(growth, expected, sum - 1));
    return (LanePair){scale, multiply_add_lanes(excess, scale, rest_of_lanes(sum, scale, (lanes)1))};
#else
    return (LanePair){1 / (1 + TERM(relative_growth) * expected), 0};
#endif
#else
    return (LanePair){1, 0};
#endif
}

// Return z less the mean as sums of two numbers. z less the offset is near z* where the density is high, so their
// difference is exact there.
INLINE LanePair hit_offset_lanes(const lanes z, const lanes expected, const lanes mean, const int any_clamped,
                                 global const MixtureTerms *terms, const ilanes bin_at) {
#if BIAS
    const LanePair unbiased = two_sum_lanes(z, -TERM(range_bias));
    LanePair off = ordered_sum_lanes(unbiased.x - expected, unbiased.y - TERM(range_bias_low));
    if (any_clamped) {
        const ilanes clamped = is_clamped_lanes(mean, expected, terms, bin_at);
        off.x = clamped ? z - mean : off.x;
        off.y = clamped ? (lanes)0 : off.y;
    }
    return off;
#else
    return (LanePair){z - expected, 0};
#endif
}

LanePair normal_exponent_lanes(const lanes z, const lanes expected, const lanes mean, const int any_clamped,
                               const LanePair scale, global const MixtureTerms *terms, const ilanes bin_at) {
    LanePair off = hit_offset_lanes(z, expected, mean, any_clamped, terms, bin_at);
#if EXACT_EXPONENT
#if GROWTH
    const LanePair scaled = two_product_lanes(off.x, scale.x);
    off.y = multiply_add_lanes(off.y, scale.x, multiply_add_lanes(scaled.x, scale.y, scaled.y));
    off.x = scaled.x;
#endif
    LanePair square = two_product_lanes(off.x, off.x);
#if BIAS
    square.y = multiply_add_lanes(2 * off.x, off.y, square.y);
#elif GROWTH
    square.y = multiply_add_lanes(2 * off.x, off.y, square.y);
#endif
    const LanePair product = two_product_lanes(square.x, TERM(square_scale));
#if GROWTH
    const lanes rest = multiply_add_lanes(square.x, TERM(square_scale_low), product.y);
    return (LanePair){product.x, multiply_add_lanes(square.y, TERM(square_scale), rest)};
#else
    return (LanePair){product.x, product.y + (square.y * TERM(square_scale) + square.x * TERM(square_scale_low))};
#endif
#else
    const lanes scaled = off.x * scale.x;
    return (LanePair){scaled * (scaled * TERM(square_scale)), 0};
#endif
}

LanePair hit_exponent_lanes(const lanes z, const lanes expected, const lanes mean, const int any_clamped,
                            const LanePair scale, global const MixtureTerms *terms, const ilanes bin_at) {
    const LanePair t = normal_exponent_lanes(z, expected, mean, any_clamped, scale, terms, bin_at);
    return shape_exponent_lanes(t, TERM(shape_power), TERM(shape_rate));
}

// Return the normal's mass between two distances from the mean, in sigma times the root of 2.
NOT_INLINE lanes mass_between_lanes(const lanes below, const lanes above) {
    return (real)0.5 * (erf_lanes(below < above ? below : above) + erf_lanes(below < above ? above : below));
}

// Return the normal's mass from a distance before its mean to one after it; within becomes whether it is 1 in every lane.
INLINE lanes hit_mass_lanes(const lanes before, const lanes after, const lanes erf_scale, int *within) {
    const lanes below = before * erf_scale, above = after * erf_scale;
    *within = !any_lane((below < above ? below : above) < ERF_ONE);
    return *within ? (lanes)1 : mass_between_lanes(below, above);
}

// Return the mass of a hit of any shape on [0, range_max]; within becomes whether it is 1 in every lane.
INLINE lanes mass_within_lanes(const lanes mean, const lanes above, const lanes scale, global const MixtureTerms *terms,
                               global const real *masses, const ilanes bin_at, int *within) {
#if MASS_TABLE
    *within = 0;
#if INCIDENCE
    const lanes begin = TERM(mass_table);
    const ilanes place = to_ilanes(begin);
#else
    const ilanes place = (int)terms->mass_table;
#endif
    return half_mass_lanes(mean * scale, masses, place) + half_mass_lanes(above * scale, masses, place);
#else
    return hit_mass_lanes(mean, above, scale, within);
#endif
}
#endif

#if SHORT
// Return (1 - exp(-lambda z*)) / lambda, the length that divides p_short: z* to the last bit where lambda z* is small.
lanes short_length_lanes(const lanes expected, global const MixtureTerms *terms, const ilanes bin_at) {
    const lanes x = TERM(lambda_short) * expected;
    const lanes length = x > SMALL_DECAY ? one_minus_exp_lanes(-x) * (1 / TERM(lambda_short)) : expected;
    return length > SMALLEST_RANGE ? length : (lanes)SMALLEST_RANGE;
}
#endif

// Densities of components, or their logarithms. A sum of densities is in the first number. The logarithm of p_short may
// omit its denominator, passed as the reciprocal of the length that divides it.
typedef struct {
    lanes hit, shorter, reciprocal;
} DensityParts;

#if LINEAR
// Return p(z | z*). p_rand > 0 bounds the sum from below, so components may underflow, and one logarithm suffices.
INLINE DensityParts density_parts_lanes(const lanes z, const lanes expected, global const MixtureTerms *terms,
                                        global const real *masses, const ilanes bin_at) {
    lanes p = TERM(rand_density);  // 4: random measurement
#if HIT
    // 1: correct range.
    int any_clamped, within;
    const lanes mean = mean_range_lanes(expected, terms, bin_at, &any_clamped);
    const lanes above = above_mean_lanes(expected, any_clamped, terms, bin_at);
    const LanePair scale = hit_scale_lanes(expected, terms, bin_at);
    const LanePair exponent = hit_exponent_lanes(z, expected, mean, any_clamped, scale, terms, bin_at);
    lanes hit = TERM(hit_peak) * exp_lanes(-exponent.x) * scale.x;
    const lanes mass = mass_within_lanes(mean, above, TERM(erf_scale) * scale.x, terms, masses, bin_at, &within);
#if EXACT_EXPONENT
    // The second part is arbitrary where the density underflows.
    hit = hit > 0 ? hit * (1 - exponent.y) : hit;
#endif
    p += within ? hit : hit / mass;
#endif
#if SHORT
    // 2: unexpected object.
    const lanes shorter = TERM(z_short) * exp_lanes(-TERM(lambda_short) * z) / short_length_lanes(expected, terms, bin_at);
    p += ((z <= expected) & (expected > 0)) ? shorter : (lanes)0;
#endif
    return (DensityParts){p, 0};
}

// Return log p(z | z*).
lanes log_of_parts_lanes(const DensityParts parts, global const MixtureTerms *terms, const ilanes bin_at) {
    return log_lanes(parts.hit);
}
#else
// Return the logarithms of components of p(z | z*).
INLINE DensityParts density_parts_lanes(const lanes z, const lanes expected, global const MixtureTerms *terms,
                                        global const real *masses, const ilanes bin_at) {
    DensityParts parts = {-INFINITY, -INFINITY, 1};
#if HIT
    // 1: correct range.
    int any_clamped, within;
    const lanes mean = mean_range_lanes(expected, terms, bin_at, &any_clamped);
    const lanes above = above_mean_lanes(expected, any_clamped, terms, bin_at);
    const LanePair scale = hit_scale_lanes(expected, terms, bin_at);
    const LanePair exponent = hit_exponent_lanes(z, expected, mean, any_clamped, scale, terms, bin_at);
    lanes hit = (TERM(hit_peak) - exponent.x) + (TERM(hit_peak_low) - exponent.y);
#if GROWTH
    hit += log_lanes(scale.x);
#endif
    const lanes mass = mass_within_lanes(mean, above, TERM(erf_scale) * scale.x, terms, masses, bin_at, &within);
    if (!within) hit = mass == 1 ? hit : hit - log_lanes(mass);
    parts.hit = hit;
#endif
#if SHORT
    // 2: unexpected object.
    const lanes length = short_length_lanes(expected, terms, bin_at);
#if SINGLE
    const lanes decayed = (TERM(z_short) - log_lanes(length)) - TERM(lambda_short) * z;
#else
    const lanes decayed = TERM(z_short) - TERM(lambda_short) * z;
    parts.reciprocal = 1 / length;
#endif
    parts.shorter = ((z <= expected) & (expected > 0)) ? decayed : (lanes)-INFINITY;
#endif
    return parts;
}

// Return log p(z | z*). Every component stays a logarithm; -inf only where the mixture is 0.
lanes log_of_parts_lanes(const DensityParts parts, global const MixtureTerms *terms, const ilanes bin_at) {
    const lanes hit = parts.hit, shorter = parts.shorter;
    lanes largest = larger_lanes(shorter, hit);
#if RAND
    // 4: random measurement.
    const lanes random = TERM(rand_density);
    largest = larger_lanes(random, largest);
#endif
#if SINGLE
    return largest;
#else
#if RAND
    lanes p = exp_lanes(random - largest);
#if HIT
    p += exp_lanes(hit - largest);
#endif
#if SHORT
    p += exp_lanes(shorter - largest) * parts.reciprocal;
#endif
#else
    // The larger numerator counts as 1; a mixture of two components has these.
    const lanes smaller = exp_lanes((hit < shorter ? hit : shorter) - largest);
    const lanes p = (hit < shorter ? smaller : (lanes)1) + (hit < shorter ? (lanes)1 : smaller) * parts.reciprocal;
#endif
    const lanes sum = largest + log_lanes(p);
    return largest == -INFINITY ? largest : sum;
#endif
}
#endif

#if CUBES
// Return the densities to be cubed: compat_density of mixture.cl.
lanes compat_density_lanes(const lanes z, const lanes expected, global const MixtureTerms *terms) {
    const lanes off = z - expected;
    lanes p = terms->hit_peak * exp_lanes(-(off * (off * terms->square_scale)));
#if AMCL
    p += z < expected ? terms->z_short * terms->lambda_short * exp_lanes(-terms->lambda_short * z) : (lanes)0;
    return z > terms->range_max ? p : p + (z >= terms->range_max ? (lanes)terms->z_max : (lanes)terms->rand_density);
#else
    int within;
    const lanes mass = hit_mass_lanes(expected, terms->range_max - expected, terms->erf_scale, &within);
    p = within ? p : p / mass;
    p += z < expected ? terms->z_short * exp_lanes(-terms->lambda_short * z) / short_length_lanes(expected, terms, 0) : (lanes)0;
    return p + (z >= terms->range_max ? (lanes)terms->z_max : (lanes)terms->rand_density);
#endif
}
#endif
