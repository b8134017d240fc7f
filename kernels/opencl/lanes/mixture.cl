// Beam mixture density of LANES readings at once: mixture.cl in lanes.
// requires: error_free mixture lanes/error_free lanes/math lanes/hit_shape

// Up to this 1 - exp(-x) is x within a quarter of the last bit.
#if FLOAT64
#define SMALL_DECAY 5.55e-17
#else
#define SMALL_DECAY 2.98023224e-08f
#endif
// Number i of the terms; the terms of a bin of angles of incidence begin at index bin_at.
#if INCIDENCE
#define TERM(i) GATHER(lanes, (terms + (i)), bin_at)
#else
#define TERM(i) terms[i]
#endif

// Return the larger numbers.
lanes larger_lanes(const lanes a, const lanes b) { return a > b ? a : b; }

#if HIT
// Return the means of p_hit; clamped becomes whether a mean is at an end of the range.
lanes mean_range_lanes(const lanes expected, global const real *terms, const ilanes bin_at, ilanes *clamped) {
#if BIAS
    const lanes wanted = expected + TERM(10), raised = wanted < 0 ? (lanes)0 : wanted;
    const lanes mean = raised > terms[6] ? (lanes)terms[6] : raised;
    *clamped = mean != wanted;
    return mean;
#else
    *clamped = 0;
    return expected;
#endif
}

// Return sigma_hit / sigma at ranges, as sums of two numbers; where exponents are computed in float64, only the first.
LanePair hit_scale_lanes(const lanes expected, global const real *terms, const ilanes bin_at) {
#if GROWTH
#if FLOAT64
#if EXACT_EXPONENT
    const LanePair growth = pair_times_lanes((LanePair){TERM(12), TERM(13)}, expected);
    const LanePair x = pair_sum_lanes((LanePair){1, 0}, growth);
    const lanes y = 1 / x.hi;
    const LanePair back = two_product_lanes(y, x.hi);
    return (LanePair){y, (((1 - back.hi) - back.lo) - y * x.lo) * y};
#endif
#endif
    return (LanePair){1 / (1 + TERM(12) * expected), 0};
#else
    return (LanePair){1, 0};
#endif
}

#if GROWTH
#if EXACT_EXPONENT
#if !FLOAT64
// Half of the readings of a vector. Sums of two numbers of float32 take twice as many operations as float64.
typedef double8 half_lanes;

// Return sums of two numbers.
half_lanes sum_of_parts(const float8 high, const float8 low) { return convert_double8(high) + convert_double8(low); }

// Return (z - mean)^2 / (2 sigma^2) of half of the readings; scale is sigma_hit / sigma, rounded to float32.
half_lanes half_exponent(const float8 z, const float8 expected, const float8 scale, const half_lanes bias,
                         const half_lanes growth, const half_lanes factor, const double range_max) {
    const half_lanes at = convert_double8(expected), rough = convert_double8(scale);
#if BIAS
    const half_lanes wanted = at + bias, raised = wanted < 0 ? (half_lanes)0 : wanted;
    const half_lanes off = convert_double8(z) - (raised > range_max ? (half_lanes)range_max : raised);
#else
    const half_lanes off = convert_double8(z) - at;
#endif
    // A step of Newton's method for the reciprocal of 1 + growth z*.
    const half_lanes scaled = off * (rough * (2 - (1 + growth * at) * rough));
    return scaled * scaled * factor;
}

// Return (z - mean)^2 / (2 sigma^2) as sums of two numbers, computed in float64.
LanePair exponent_of_halves(const lanes z, const lanes expected, const lanes scale, global const real *terms,
                            const ilanes bin_at) {
    const lanes bias = TERM(10), bias_low = TERM(11), growth = TERM(12), growth_low = TERM(13);
    const lanes factor = TERM(1), factor_low = TERM(9);
    const half_lanes first = half_exponent(z.lo, expected.lo, scale.lo, sum_of_parts(bias.lo, bias_low.lo),
                                           sum_of_parts(growth.lo, growth_low.lo),
                                           sum_of_parts(factor.lo, factor_low.lo), terms[6]);
    const half_lanes second = half_exponent(z.hi, expected.hi, scale.hi, sum_of_parts(bias.hi, bias_low.hi),
                                            sum_of_parts(growth.hi, growth_low.hi),
                                            sum_of_parts(factor.hi, factor_low.hi), terms[6]);
    const float8 high = convert_float8(first), other = convert_float8(second);
    return (LanePair){(lanes)(high, other), (lanes)(convert_float8(first - convert_double8(high)),
                                                    convert_float8(second - convert_double8(other)))};
}
#endif
#endif
#endif

// Return (z - mean)^2 / (2 sigma^2) as sums of two numbers.
LanePair normal_exponent_lanes(const lanes z, const lanes expected, const lanes mean, const ilanes clamped,
                               const LanePair scale, global const real *terms, const ilanes bin_at) {
#if GROWTH
#if EXACT_EXPONENT
#if !FLOAT64
    return exponent_of_halves(z, expected, scale.hi, terms, bin_at);
#endif
#endif
#endif
    LanePair off = {z - expected, 0};
#if BIAS
    // z, z* and the bias nearly cancel.
    const LanePair bias = {-TERM(10), -TERM(11)};
    off = pair_sum_lanes(two_sum_lanes(z, -expected), bias);
    off.hi = clamped ? z - mean : off.hi;
    off.lo = clamped ? (lanes)0 : off.lo;
#endif
#if EXACT_EXPONENT
    LanePair square = two_product_lanes(off.hi, off.hi);
#if BIAS
    square.lo += 2 * off.hi * off.lo;
#endif
    const LanePair product = two_product_lanes(square.hi, TERM(1));
    const LanePair exponent = {product.hi, product.lo + (square.lo * TERM(1) + square.hi * TERM(9))};
#if GROWTH
    return pair_product_lanes(exponent, pair_product_lanes(scale, scale));
#else
    return exponent;
#endif
#else
#if GROWTH
    const lanes scaled = off.hi * scale.hi;
    return (LanePair){scaled * (scaled * TERM(1)), 0};
#else
    return (LanePair){off.hi * (off.hi * TERM(1)), 0};
#endif
#endif
}

// Return the exponents of a hit's density as sums of two numbers.
LanePair hit_exponent_lanes(const lanes z, const lanes expected, const lanes mean, const ilanes clamped,
                            const LanePair scale, global const real *terms, const ilanes bin_at) {
    const LanePair t = normal_exponent_lanes(z, expected, mean, clamped, scale, terms, bin_at);
    return shape_exponent_lanes(t, TERM(17), TERM(18));
}

// Return the normal's mass on [0, range_max]; within becomes whether it is 1 in every lane.
lanes hit_mass_lanes(const lanes mean, const lanes erf_scale, const real range_max, int *within) {
    const lanes below = mean * erf_scale, above = (range_max - mean) * erf_scale;
    const lanes nearer = below < above ? below : above;
    *within = !any_lane(nearer < ERF_ONE);
    if (*within) return 1;
    return (real)0.5 * (erf_lanes(nearer) + erf_lanes(below < above ? above : below));
}

// Return the mass of a hit of any shape on [0, range_max]; within becomes whether it is 1 in every lane.
lanes mass_within_lanes(const lanes mean, const lanes scale, global const real *terms, const ilanes bin_at,
                        int *within) {
#if MASS_TABLE
    *within = 0;
#if INCIDENCE
    const lanes after = TERM(19);
    const ilanes place = bin_at + to_ilanes(after);
#else
    const ilanes place = (int)terms[19];
#endif
    return half_mass_lanes(mean * scale, terms, place) + half_mass_lanes((terms[6] - mean) * scale, terms, place);
#else
    return hit_mass_lanes(mean, scale, terms[6], within);
#endif
}
#endif

#if SHORT
// Return (1 - exp(-lambda z*)) / lambda, the length that divides p_short: z* to the last bit where lambda z* is small.
lanes short_length_lanes(const lanes expected, global const real *terms, const ilanes bin_at) {
    const lanes x = TERM(4) * expected;
    const lanes length = x > SMALL_DECAY ? one_minus_exp_lanes(-x) * (1 / TERM(4)) : expected;
    return length > SMALLEST_RANGE ? length : (lanes)SMALLEST_RANGE;
}
#endif

#if LINEAR
// Return log p(z | z*). p_rand > 0 bounds the sum from below, so components may underflow, and one logarithm suffices.
lanes log_density_lanes(const lanes z, const lanes expected, global const real *terms, const ilanes bin_at) {
    lanes p = TERM(5);
#if HIT
    ilanes clamped;
    int within;
    const lanes mean = mean_range_lanes(expected, terms, bin_at, &clamped);
    const LanePair scale = hit_scale_lanes(expected, terms, bin_at);
    const LanePair exponent = hit_exponent_lanes(z, expected, mean, clamped, scale, terms, bin_at);
    lanes hit = TERM(0) * exp_lanes(-exponent.hi);
#if GROWTH
    hit *= scale.hi;
    const lanes mass = mass_within_lanes(mean, TERM(2) * scale.hi, terms, bin_at, &within);
#else
    const lanes mass = mass_within_lanes(mean, TERM(2), terms, bin_at, &within);
#endif
#if EXACT_EXPONENT
    // Where the density underflows, the second part is arbitrary.
    hit = hit > 0 ? hit * (1 - exponent.lo) : hit;
#endif
    p += within ? hit : hit / mass;
#endif
#if SHORT
    const lanes shorter = TERM(3) * exp_lanes(-TERM(4) * z) / short_length_lanes(expected, terms, bin_at);
    p += ((z <= expected) & (expected > 0)) ? shorter : (lanes)0;
#endif
    return log_lanes(p);
}
#else
// Return log p(z | z*). Every component stays a logarithm; -inf only where the mixture is 0.
lanes log_density_lanes(const lanes z, const lanes expected, global const real *terms, const ilanes bin_at) {
    lanes largest = -INFINITY;
#if HIT
    ilanes clamped;
    int within;
    const lanes mean = mean_range_lanes(expected, terms, bin_at, &clamped);
    const LanePair scale = hit_scale_lanes(expected, terms, bin_at);
    const LanePair exponent = hit_exponent_lanes(z, expected, mean, clamped, scale, terms, bin_at);
    lanes hit = (TERM(0) - exponent.hi) + (TERM(8) - exponent.lo);
#if GROWTH
    hit += log_lanes(scale.hi);
    const lanes mass = mass_within_lanes(mean, TERM(2) * scale.hi, terms, bin_at, &within);
#else
    const lanes mass = mass_within_lanes(mean, TERM(2), terms, bin_at, &within);
#endif
    if (!within) hit = mass == 1 ? hit : hit - log_lanes(mass);
    largest = hit;
#endif
#if SHORT
    const lanes decayed = (TERM(3) - log_lanes(short_length_lanes(expected, terms, bin_at))) - TERM(4) * z;
    const lanes shorter = ((z <= expected) & (expected > 0)) ? decayed : (lanes)-INFINITY;
    largest = larger_lanes(shorter, largest);
#endif
#if RAND
    const lanes random = TERM(5);
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
    p += exp_lanes(shorter - largest);
#endif
#else
    // The larger component counts as 1.
    lanes p = 1;
#if HIT
#if SHORT
    p += exp_lanes((hit < shorter ? hit : shorter) - largest);
#endif
#endif
#endif
    const lanes sum = largest + log_lanes(p);
    return largest == -INFINITY ? largest : sum;
#endif
}
#endif

#if CUBES
// Return the densities to be cubed: compat_density of compat.cl.
lanes compat_density_lanes(const lanes z, const lanes expected, global const real *terms) {
    const lanes off = z - expected;
    lanes p = terms[0] * exp_lanes(-(off * (off * terms[1])));
#if AMCL
    p += z < expected ? terms[3] * terms[4] * exp_lanes(-terms[4] * z) : (lanes)0;
    return z > terms[6] ? p : p + (z >= terms[6] ? (lanes)terms[7] : (lanes)terms[5]);
#else
    int within;
    const lanes mass = hit_mass_lanes(expected, terms[2], terms[6], &within);
    p = within ? p : p / mass;
    p += z < expected ? terms[3] * exp_lanes(-terms[4] * z) / short_length_lanes(expected, terms, 0) : (lanes)0;
    return p + (z >= terms[6] ? (lanes)terms[7] : (lanes)terms[5]);
#endif
}
#endif
