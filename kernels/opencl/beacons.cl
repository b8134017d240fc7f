// Density of ranges to known beacons, each truncated to [0, range_max] and mixed with a uniform one; see the reference.
// requires: error_free log_terms

// From this tangent on an arc is a quarter turn to the last bit; the tangent's square is still finite.
#define STEEPEST ((real)1e18)
// From here on the error function is 1 to the last bit.
#define ERF_ONE ((real)(FLOAT64 ? 6 : 4))

// Return the log of a truncated normal; near and far are the distances from its mean to the ends.
real log_normal(const real2 residual, const real near, const real far, const real2 scale, const real2 peak) {
    const real below = near * scale.x, above = far * scale.x;
    const real2 exponent = bounded_square(pair_product(residual, scale));
    const real untruncated = (peak.x - exponent.x) + (peak.y - exponent.y);
    if (!in_any((below < ERF_ONE) | (above < ERF_ONE))) return untruncated;
    return untruncated - log((real)0.5 * (erf(below) + erf(above)));
}

// Return the mass of a Student t between -t and t; t >= 0 is in units of its scale and sqrt(nu).
real t_mass(const real any_t, global const BeaconTerms *terms, global const real *series, const int count) {
    const real t = any_t < STEEPEST ? any_t : STEEPEST, cosine = 1 / sqrt(1 + t * t), square = cosine * cosine;
    real sum = 0;
    for (int i = count - 1; i >= 0; --i) sum = sum * square + series[i];
    if (!(terms->odd > 0)) return t * cosine * sum;
    return terms->arc * atan(t) + t * cosine * cosine * sum;
}

// Return the log of a truncated Student t. Its argument, (1 + u^2 / nu) / k, includes the peak and is a sum of two
// numbers; -(nu + 1) / 2 is the factor of its log.
real log_student_t(const real2 residual, const real near, const real far, global const BeaconTerms *terms,
                   global const real *series, const int count) {
    const real2 squared = bounded_square(pair_product(residual, (real2)(terms->scale, terms->scale_low)));
    const real2 x = pair_sum((real2)(terms->offset, terms->offset_low), squared);
    const real below = t_mass(near * terms->t_scale, terms, series, count);
    const real above = t_mass(far * terms->t_scale, terms, series, count);
    return (terms->peak - terms->power * (log(x.x) + x.y / x.x)) - log((real)0.5 * (below + above));
}

// Return log p of one range at a distance.
real log_range(const real2 d, global const real *beacon, global const BeaconTerms *terms, global const real *series,
               const int count, const int kind) {
    const real2 first = two_sum(d.x, -beacon[4]), r = two_sum(first.x, first.y + (d.y - beacon[5]));
    const real mean = d.x + beacon[6], above = mean > 0 ? mean : (real)0, most = terms->range_max;
    const real near = above < most ? above : most, far = most - near;
    real log_p;
    if (kind == STUDENT_T)
        log_p = log_student_t(r, near, far, terms, series, count);
    else
        log_p = log_normal(r, near, far, (real2)(terms->scale, terms->scale_low), (real2)(terms->peak, terms->peak_low));
    if (kind == TWO_NORMALS)
        log_p = either(log_p, log_normal(r, near, far, (real2)(terms->wide_scale, terms->wide_scale_low),
                                         (real2)(terms->wide_peak, terms->wide_peak_low)));
#if RAND
    return either(log_p, terms->random);
#else
    return log_p;
#endif
}

// Return the sum of log p of the ranges over beacons. The first count numbers of the series belong to a t.
real2 log_ranges(const real4 sensor, global const real *beacon, const int beacons, global const BeaconTerms *terms,
                 global const real *series, const int count, const int kind) {
    real2 total = (real2)(0, 0);
    for (int i = 0; i < beacons; ++i) {
        global const real *numbers = beacon + BEACON * i;
        const real2 d = distance_pair(offset((real4)(numbers[0], numbers[2], numbers[1], numbers[3]), sensor));
        total = add_term(total, log_range(d, numbers, terms, series, count, kind));
    }
    return total;
}

// Sum log p of the ranges over beacons: one work-item takes a particle.
kernel void score_beacons(ARGUMENTS) {
    const int n = get_global_id(0);
    if (n >= particles) return;
    log_p[n] = scaled_sum(log_ranges(place[n], beacon, beacons, terms, series, count, kind), temperature);
}
