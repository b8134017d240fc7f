// Ranges to known beacons for LANES particles at once: beacons.cl in lanes, with the functions of lanes/math. Sums have
// the order of the scalar kernel.
// requires: lanes/log_terms

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

// in lanes: STEEPEST ERF_ONE log_normal t_mass log_student_t log_range log_ranges

// Sum log p of the ranges over beacons: one work-item takes LANES particles. Missing particles repeat the last one.
kernel void score_beacons(ARGUMENTS) {
    const int first = LANES * get_global_id(0);
    if (first >= particles) return;
    const LaneQuad sensor = load_places(place, first, particles);
    const LanePair total = log_ranges_lanes(sensor, beacon, beacons, terms, series, count, kind);
    store_some(scaled_sum_lanes(total, temperature), log_p + first, particles - first);
}
