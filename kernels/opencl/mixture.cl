// Beam mixture density of one range reading, log p(z | z*), book equations 6.4 to 6.12 without the max atom.
// terms[20] = {hit, 1 / (2 sigma^2), 1 / (sigma sqrt 2), short, lambda, rand, range_max, log z_max, the low parts of
// terms 0 and 1, range_bias and its low part, sigma_growth / sigma_hit and its low part, three numbers for last_range,
// two numbers of the shape of a hit, the place of the table of its masses after the first term}. In the linear domain
// hit is z_hit / (sigma sqrt(2 pi)) for a normal, short is z_short and rand is z_rand / range_max; in the log domain
// they are the logarithms of these. The mean of p_hit is z* + range_bias on [0, range_max] (BIAS), and its sigma is
// sigma_hit + sigma_growth z* (GROWTH).
// requires: error_free hit_shape

#define MIXTURE_TERMS 20
// From here on the error function is 1 to the last bit.
#define ERF_ONE ((real)(FLOAT64 ? 6 : 4))
// Keep 2 / x and 1 / z* finite.
#define TINY_DECAY ((real)1e-30)
#define SMALLEST_RANGE ((real)1e-37)

#if STOPS
// Return the expected range of a reading beyond which log p is constant to the last bit: there it is that of p_rand, or
// of p_short far from its end, whatever the distance of the obstacle.
real last_range(const real z, global const real *terms) {
    const real last = terms[14] + terms[15] * z;
    return last > terms[16] ? last : terms[16];
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
real mass_within(const real mean, const real above, const real scale, global const real *terms) {
#if MASS_TABLE
    global const real *table = terms + (int)terms[19];
    return half_mass(mean * scale, table) + half_mass(above * scale, table);
#else
    return hit_mass(mean, above, scale);
#endif
}

// Return the mean of p_hit.
real mean_range(const real expected, global const real *terms) {
#if BIAS
    const real mean = expected + terms[10];
    return mean < 0 ? 0 : mean > terms[6] ? terms[6] : mean;
#else
    return expected;
#endif
}

// Return the distance from the mean of p_hit to range_max, which keeps its digits where it is short: there z* is nearly
// range_max less the bias, and their difference is exact.
real above_mean(const real expected, global const real *terms) {
#if BIAS
    const real2 last = two_sum(terms[6], -terms[10]);
    const real above = (last.x - expected) + (last.y - terms[11]);
    return above < 0 ? 0 : above > terms[6] ? terms[6] : above;
#else
    return terms[6] - expected;
#endif
}

// Return z minus the mean of p_hit as a sum of two numbers; z, z* and the bias nearly cancel.
real2 hit_offset(const real z, const real expected, global const real *terms) {
#if BIAS
    const real mean = mean_range(expected, terms);
    if (mean != expected + terms[10]) return (real2)(z - mean, 0);
    return pair_sum(two_sum(z, -expected), (real2)(-terms[10], -terms[11]));
#else
    return (real2)(z - expected, 0);
#endif
}

// Return sigma_hit / sigma at a range: the first number times (1 + the second).
real2 hit_scale(const real expected, global const real *terms) {
#if GROWTH
    const real sum = 1 + terms[12] * expected, scale = 1 / sum;
#if EXACT_EXPONENT
    // Rounding error of the sum; below 2^24 the sum less 1 is exact.
    const real excess = rest_of(terms[12], expected, sum - 1) - terms[13] * expected;
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
real2 normal_exponent(const real z, const real expected, global const real *terms) {
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
    const real2 product = two_product(square.x, terms[1]);
    return (real2)(product.x, product.y + (square.y * terms[1] + square.x * terms[9]));
#else
#if GROWTH
    const real scaled = off.x * hit_scale(expected, terms).x;
    return (real2)(scaled * (scaled * terms[1]), 0);
#else
    return (real2)(off.x * (off.x * terms[1]), 0);
#endif
#endif
}

// Return the exponent of a hit's density as a sum of two numbers.
real2 hit_exponent(const real z, const real expected, global const real *terms) {
    return shape_exponent(normal_exponent(z, expected, terms), terms[17], terms[18]);
}

// Return log(z_hit p_hit(z | z*)); terms are in the log domain.
real log_hit(const real z, const real expected, global const real *terms) {
    const real2 exponent = hit_exponent(z, expected, terms);
    const real scale = hit_scale(expected, terms).x;
    real log_p = (terms[0] - exponent.x) + (terms[8] - exponent.y);
#if GROWTH
    log_p += log(scale);
#endif
    const real mass = mass_within(mean_range(expected, terms), above_mean(expected, terms), terms[2] * scale, terms);
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
real log_short(const real z, const real expected, global const real *terms) {
    if (!(z <= expected && expected > 0)) return -INFINITY;
    return (terms[3] + log(short_peak(terms[4], expected))) - terms[4] * z;
}
#endif

#if LINEAR
// Return log p(z | z*). p_rand > 0 bounds the sum from below, so components may underflow, and one logarithm suffices.
real log_density(const real z, const real expected, global const real *terms) {
    real p = 0;
#if HIT
    const real2 exponent = hit_exponent(z, expected, terms);
    const real scale = hit_scale(expected, terms).x;
    const real hit = terms[0] * scale * exp(-exponent.x) * (1 - exponent.y);
    const real mass = mass_within(mean_range(expected, terms), above_mean(expected, terms), terms[2] * scale, terms);
    p += mass == 1 ? hit : hit / mass;
#endif
#if SHORT
    if (z <= expected && expected > 0) p += terms[3] * exp(-terms[4] * z) * short_peak(terms[4], expected);
#endif
    return log(p + terms[5]);
}
#else
// Return log p(z | z*). Without a sufficient p_rand every component stays a logarithm; -inf only where the mixture is
// 0.
real log_density(const real z, const real expected, global const real *terms) {
    real largest = -INFINITY;
#if HIT
    const real hit = log_hit(z, expected, terms);
    largest = hit;
#endif
#if SHORT
    const real shorter = log_short(z, expected, terms);
    largest = fmax(largest, shorter);
#endif
#if RAND
    largest = fmax(largest, terms[5]);
#endif
#if SINGLE
    return largest;
#else
    if (isinf(largest)) return largest;
    real p = 0;
#if HIT
    p += exp(hit - largest);
#endif
#if SHORT
    p += exp(shorter - largest);
#endif
#if RAND
    p += exp(terms[5] - largest);
#endif
    return largest + log(p);
#endif
}
#endif
