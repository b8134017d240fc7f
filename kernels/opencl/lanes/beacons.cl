// Ranges to known beacons for LANES particles at once: beacons.cl in lanes, with the functions of lanes/math. Sums have
// the order of the scalar kernel.
// requires: lanes/log_terms

// in lanes: STEEPEST

// tan(pi/8), pi/4 and pi/2.
#define EIGHTH_SLOPE 0.414213562f
#define EIGHTH_TURN 0.785398163f
#define QUARTER_TURN 1.57079633f

// Return arctan t for t >= 0.
lanes atan_lanes(const lanes t) {
    const ilanes steep = t > 1;
    const lanes high = steep ? (lanes)1 : t, low = steep ? t : (lanes)1;
    const ilanes large = high > EIGHTH_SLOPE * low;
    const lanes slope = (large ? high - low : high) / (large ? high + low : low);
    const lanes arc = (large ? (lanes)EIGHTH_TURN : (lanes)0) + (slope + arc_rest_lanes(slope));
    return steep ? QUARTER_TURN - arc : arc;
}

lanes log_normal_lanes(const LanePair residual, const lanes near, const lanes far, const float2 scale,
                       const float2 peak) {
    const LanePair exponent = bounded_square_lanes(scaled_pair_lanes(residual, scale.x, scale.y));
    const lanes untruncated = (peak.x - exponent.hi) + (peak.y - exponent.lo);
    const lanes nearest = (near < far ? near : far) * scale.x;
    if (!any_lane(nearest < LANE_ERF_ONE)) return untruncated;
    return untruncated - log_lanes(0.5f * (erf_lanes(near * scale.x) + erf_lanes(far * scale.x)));
}

// in lanes: t_mass

lanes log_student_t_lanes(const LanePair residual, const lanes near, const lanes far, global const BeaconTerms *terms,
                          global const real *series, const int count) {
    const LanePair squared = bounded_square_lanes(scaled_pair_lanes(residual, terms->scale, terms->scale_low));
    const LanePair sum = two_sum_lanes((lanes)terms->offset, squared.hi);
    const LanePair x = two_sum_lanes(sum.hi, sum.lo + (terms->offset_low + squared.lo));
    const lanes below = t_mass_lanes(near * terms->t_scale, terms, series, count);
    const lanes above = t_mass_lanes(far * terms->t_scale, terms, series, count);
    return (terms->peak - terms->power * (log_lanes(x.hi) + x.lo / x.hi)) - log_lanes(0.5f * (below + above));
}

lanes log_range_lanes(const LanePair d, global const real *beacon, global const BeaconTerms *terms,
                      global const real *series,
                      const int count, const int kind) {
    const LanePair first = two_sum_lanes(d.hi, (lanes)-beacon[4]);
    const LanePair r = two_sum_lanes(first.hi, first.lo + (d.lo - beacon[5]));
    lanes near = d.hi + beacon[6];
    near = near > 0 ? near : (lanes)0;
    near = near < terms->range_max ? near : (lanes)terms->range_max;
    const lanes far = terms->range_max - near;
    lanes log_p;
    if (kind == STUDENT_T)
        log_p = log_student_t_lanes(r, near, far, terms, series, count);
    else
        log_p = log_normal_lanes(r, near, far, (float2)(terms->scale, terms->scale_low),
                                 (float2)(terms->peak, terms->peak_low));
    if (kind == TWO_NORMALS)
        log_p = either_lanes(log_p, log_normal_lanes(r, near, far, (float2)(terms->wide_scale, terms->wide_scale_low),
                                                     (float2)(terms->wide_peak, terms->wide_peak_low)));
#if RAND
    return either_lanes(log_p, (lanes)terms->random);
#else
    return log_p;
#endif
}

// Sum log p of the ranges over beacons: one work-item takes LANES particles. Missing particles repeat the last one.
kernel void score_beacons(ARGUMENTS) {
    const int first_particle = LANES * get_global_id(0);
    if (first_particle >= particles) return;
    const LanePlace sensor = load_places(place, first_particle, particles);
    LanePair total = {0, 0};
    for (int i = 0; i < beacons; ++i) {
        global const real *numbers = beacon + BEACON * i;
        const real4 here = (real4)(numbers[0], numbers[2], numbers[1], numbers[3]);
        const LanePair d = distance_pair_lanes(offset_lanes(here, sensor));
        const LanePair sum = two_sum_lanes(total.hi, log_range_lanes(d, numbers, terms, series, count, kind));
        total = (LanePair){sum.hi, total.lo + sum.lo};
    }
    const ilanes finite = total.hi - total.hi == 0;
    const lanes all = finite ? temperature * (total.hi + total.lo) : total.hi;
    store_some(all, log_p + first_particle, particles - first_particle);
}
