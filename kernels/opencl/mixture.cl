// Beam mixture density of one range reading, log p(z | z*), book equations 6.4 to 6.12 without the max atom; see the
// reference. masses are tables of the masses of hits.
// requires: error_free hit_shape

// From here on the error function is 1 to the last bit.
#define ERF_ONE ((real)(FLOAT64 ? 6 : 4))
// Keep 2 / x and 1 / z* finite.
#define TINY_DECAY ((real)1e-30)
#define SMALLEST_RANGE ((real)1e-37)

#if STOPS
// Return the expected range of a reading beyond which log p is constant to the last bit: there it is that of p_rand, or
// of p_short far from its end, whatever the distance of the obstacle.
real last_range(const real z, global const MixtureTerms *terms) {
    const real last = terms->last_offset + terms->last_slope * z, least = terms->last_least;
    return last > least ? last : least;
}
#endif

#if HIT
// Return the mass of the untruncated normal from a distance before its mean to one after it, a sum of positive terms.
// Most ranges are far from both ends, and nearly all from at least one; rays without an obstacle are at one end.
real hit_mass(const real before, const real after, const real erf_scale) {
    const real below = before * erf_scale, above = after * erf_scale;
    const real nearer = below < above ? below : above, farther = below < above ? above : below;
    if (nearer > ERF_ONE) return 1;
    const real rest = farther > ERF_ONE ? (real)1 : erf(farther);
    return (real)0.5 * (nearer > 0 ? erf(nearer) + rest : rest);
}

// Return the mass of a hit of any shape on [0, range_max], given its mean and the distance from there to range_max.
real mass_within(const real mean, const real above, const real scale, global const MixtureTerms *terms,
                 global const real *masses) {
#if MASS_TABLE
    global const real *table = masses + (int)terms->mass_table;
    return half_mass(mean * scale, table) + half_mass(above * scale, table);
#else
    return hit_mass(mean, above, scale);
#endif
}

// Return the mean of p_hit.
real mean_range(const real expected, global const MixtureTerms *terms) {
#if BIAS
    const real mean = expected + terms->range_bias;
    return mean < 0 ? 0 : mean > terms->range_max ? terms->range_max : mean;
#else
    return expected;
#endif
}

// Return the distance from the mean of p_hit to range_max, which keeps its digits where it is short: there z* is nearly
// range_max less the bias, and their difference is exact.
real above_mean(const real expected, global const MixtureTerms *terms) {
#if BIAS
    const real2 last = two_sum(terms->range_max, -terms->range_bias);
    const real above = (last.x - expected) + (last.y - terms->range_bias_low);
    return above < 0 ? 0 : above > terms->range_max ? terms->range_max : above;
#else
    return terms->range_max - expected;
#endif
}

// Return z minus the mean of p_hit as a sum of two numbers; z, z* and the bias nearly cancel.
real2 hit_offset(const real z, const real expected, global const MixtureTerms *terms) {
#if BIAS
    const real mean = mean_range(expected, terms);
    if (mean != expected + terms->range_bias) return (real2)(z - mean, 0);
    return pair_sum(two_sum(z, -expected), (real2)(-terms->range_bias, -terms->range_bias_low));
#else
    return (real2)(z - expected, 0);
#endif
}

// Return sigma_hit / sigma at a range: the first number times (1 + the second).
real2 hit_scale(const real expected, global const MixtureTerms *terms) {
#if GROWTH
    const real sum = 1 + terms->relative_growth * expected, scale = 1 / sum;
#if EXACT_EXPONENT
    // Rounding error of the sum; below 2^24 the sum less 1 is exact.
    const real excess = rest_of(terms->relative_growth, expected, sum - 1) - terms->relative_growth_low * expected;
    return (real2)(scale, rest_of(sum, scale, 1) + excess * scale);
#else
    return (real2)(scale, 0);
#endif
#else
    return (real2)(1, 0);
#endif
}

// Return (z - mean)^2 / (2 sigma^2) as a sum of two numbers. Exponent and log peak are large and nearly cancel where
// the density's peak is high; the second part keeps the digits that remain.
real2 normal_exponent(const real z, const real expected, global const MixtureTerms *terms) {
    real2 off = hit_offset(z, expected, terms);
#if EXACT_EXPONENT
#if GROWTH
    const real2 scale = hit_scale(expected, terms);
    const real scaled = off.x * scale.x;
    off.y = (off.y * scale.x + scaled * scale.y) - rest_of(off.x, scale.x, scaled);
    off.x = scaled;
#endif
    real2 square = two_product(off.x, off.x);
#if BIAS
    square.y += 2 * off.x * off.y;
#elif GROWTH
    square.y += 2 * off.x * off.y;
#endif
    const real2 product = two_product(square.x, terms->square_scale);
    return (real2)(product.x, product.y + (square.y * terms->square_scale + square.x * terms->square_scale_low));
#else
#if GROWTH
    const real scaled = off.x * hit_scale(expected, terms).x;
    return (real2)(scaled * (scaled * terms->square_scale), 0);
#else
    return (real2)(off.x * (off.x * terms->square_scale), 0);
#endif
#endif
}

// Return the exponent of a hit's density as a sum of two numbers.
real2 hit_exponent(const real z, const real expected, global const MixtureTerms *terms) {
    return shape_exponent(normal_exponent(z, expected, terms), terms->shape_power, terms->shape_rate);
}

// Return log(z_hit p_hit(z | z*)); terms are in the log domain.
real log_hit(const real z, const real expected, global const MixtureTerms *terms, global const real *masses) {
    const real2 exponent = hit_exponent(z, expected, terms);
    const real scale = hit_scale(expected, terms).x;
    real log_p = (terms->hit_peak - exponent.x) + (terms->hit_peak_low - exponent.y);
#if GROWTH
    log_p += log(scale);
#endif
    const real mass = mass_within(mean_range(expected, terms), above_mean(expected, terms), terms->erf_scale * scale, terms,
                                  masses);
    return mass == 1 ? log_p : log_p - log(mass);
}
#endif

#if SHORT
// Return x / (1 - exp(-x)) for x >= 0 as h / tanh(h) + h with h = x / 2: exact at 0 and without cancellation.
real short_factor(const real x) {
    const real h = (real)0.5 * x;
    return h > TINY_DECAY ? h / tanh(h) + h : (real)1;
}

// Return short_factor(x) / z* with one division: lambda / (1 - exp(-2 h)) = lambda (1 + t) / (2 t) with t = tanh(h).
real short_peak(const real lambda, const real expected) {
    const real h = (real)0.5 * (lambda * expected), t = tanh(h);
    const real shortest = expected > SMALLEST_RANGE ? expected : SMALLEST_RANGE;
    return (h > TINY_DECAY ? lambda * (1 + t) : (real)1) / (h > TINY_DECAY ? 2 * t : shortest);
}

// Return log(z_short p_short(z | z*)); terms are in the log domain.
real log_short(const real z, const real expected, global const MixtureTerms *terms) {
    if (!(z <= expected && expected > 0)) return -INFINITY;
    return (terms->z_short + log(short_peak(terms->lambda_short, expected))) - terms->lambda_short * z;
}
#endif

#if LINEAR
// Return log p(z | z*). p_rand > 0 bounds the sum from below, so components may underflow, and one logarithm suffices.
real log_density(const real z, const real expected, global const MixtureTerms *terms, global const real *masses) {
    real p = 0;
#if HIT
    // 1: correct range.
    const real2 exponent = hit_exponent(z, expected, terms);
    const real scale = hit_scale(expected, terms).x;
    const real hit = terms->hit_peak * scale * exp(-exponent.x) * (1 - exponent.y);
    const real mass = mass_within(mean_range(expected, terms), above_mean(expected, terms), terms->erf_scale * scale, terms,
                                  masses);
    p += mass == 1 ? hit : hit / mass;
#endif
#if SHORT
    // 2: unexpected object.
    if (z <= expected && expected > 0)
        p += terms->z_short * exp(-terms->lambda_short * z) * short_peak(terms->lambda_short, expected);
#endif
    // 4: random measurement.
    return log(p + terms->rand_density);
}
#else
// Return log p(z | z*). Without a sufficient p_rand every component stays a logarithm; -inf only where the mixture is
// 0.
real log_density(const real z, const real expected, global const MixtureTerms *terms, global const real *masses) {
    real largest = -INFINITY;
#if HIT
    const real hit = log_hit(z, expected, terms, masses);
    largest = hit;
#endif
#if SHORT
    const real shorter = log_short(z, expected, terms);
    largest = fmax(largest, shorter);
#endif
#if RAND
    largest = fmax(largest, terms->rand_density);
#endif
#if SINGLE
    return largest;
#else
    if (isinf(largest)) return largest;
    real p = 0;
#if HIT
    p += exp(hit - largest);  // 1: correct range
#endif
#if SHORT
    p += exp(shorter - largest);  // 2: unexpected object
#endif
#if RAND
    p += exp(terms->rand_density - largest);  // 4: random measurement
#endif
    return largest + log(p);
#endif
}
#endif

#if CUBES
// Return the density whose cube nav2_amcl and Beluga add for each beam of a scan: amcl's without
// normalisers, Beluga's with both (book table 6.1). Terms are linear; hit_peak is z_hit alone for amcl, and z_max is no
// logarithm. A reading of range_max is a max reading; amcl's longer readings are neither random nor max readings.
real compat_density(const real z, const real expected, global const MixtureTerms *terms) {
    const real off = z - expected, lambda = terms->lambda_short;
    real p = terms->hit_peak * exp(-(off * (off * terms->square_scale)));
#if AMCL
    if (z < expected) p += terms->z_short * lambda * exp(-lambda * z);
    if (z > terms->range_max) return p;
#else
    p /= hit_mass(expected, terms->range_max - expected, terms->erf_scale);
    if (z < expected) p += terms->z_short * short_factor(lambda * expected) * exp(-lambda * z) / expected;
#endif
    return p + (z >= terms->range_max ? terms->z_max : terms->rand_density);
}
#endif
