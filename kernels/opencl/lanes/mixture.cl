// Beam mixture density of LANES readings at once: mixture.cl in the linear domain, without SHARP.
// requires: mixture lanes/math

// Up to this 1 - exp(-x) is x within a quarter of the last bit of float32.
#define SMALL_DECAY 2.98023224e-08f

// Return log p(z | z*). p_rand is at least 1e-30 times the larger of 1 and the peak. So each component may underflow,
// which begins at 2e-38, and one logarithm is enough.
lanes log_density_lanes(const lanes z, const lanes expected, global const real *terms) {
    lanes p = terms[5];
#if HIT
#if BIAS
    const lanes wanted = expected + terms[10], least = wanted < 0 ? (lanes)0 : wanted;
    const lanes mean = least > terms[6] ? (lanes)terms[6] : least;
    // z, z* and the bias nearly cancel, so the rounding error of z - z* is added.
    const lanes apart = z - expected, shift = apart - z, error = (z - (apart - shift)) - (expected + shift);
    lanes off = mean == wanted ? (apart - terms[10]) + (error - terms[11]) : z - mean;
#else
    const lanes mean = expected;
    lanes off = z - expected;
#endif
#if GROWTH
    const lanes scale = 1 / (1 + terms[12] * expected), erf_scale = terms[2] * scale, peak = terms[0] * scale;
    off *= scale;
#else
    const real erf_scale = terms[2], peak = terms[0];
#endif
    const lanes hit = peak * exp_lanes(off * (off * -terms[1]));
    // The normal has all of its mass within the range unless one end is near.
    const lanes below = mean * erf_scale, above = (terms[6] - mean) * erf_scale;
    const lanes nearer = below < above ? below : above;
    if (any_lane(nearer < ERF_ONE))
        p += hit / (0.5f * (erf_lanes(nearer) + erf_lanes(below < above ? above : below)));
    else
        p += hit;
#endif
#if SHORT
    // short_factor(x) / z* with one division: (1 - exp(-x)) / lambda is z* to the last bit where x is small.
    const lanes x = terms[4] * expected;
    const lanes length = x > SMALL_DECAY ? one_minus_exp_lanes(-x) * (1 / terms[4]) : expected;
    const lanes divisor = length > SMALLEST_RANGE ? length : (lanes)SMALLEST_RANGE;
    const lanes within = terms[3] * exp_lanes(-terms[4] * z) / divisor;
    p += ((z <= expected) & (expected > 0)) ? within : (lanes)0;
#endif
    return log_lanes(p);
}
