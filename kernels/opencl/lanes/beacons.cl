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

// in lanes: STEEPEST ERF_ONE log_normal t_mass log_student_t log_range

// Sum log p of the ranges over beacons: one work-item takes LANES particles. Missing particles repeat the last one.
kernel void score_beacons(ARGUMENTS) {
    const int first_particle = LANES * get_global_id(0);
    if (first_particle >= particles) return;
    const LaneQuad sensor = load_places(place, first_particle, particles);
    LanePair total = {0, 0};
    for (int i = 0; i < beacons; ++i) {
        global const real *numbers = beacon + BEACON * i;
        const real4 here = (real4)(numbers[0], numbers[2], numbers[1], numbers[3]);
        const LanePair d = distance_pair_lanes(offset_lanes(in_all_lanes(here), sensor));
        total = add_term_lanes(total, log_range_lanes(d, numbers, terms, series, count, kind));
    }
    const ilanes finite = total.x - total.x == 0;
    const lanes all = finite ? temperature * (total.x + total.y) : total.x;
    store_some(all, log_p + first_particle, particles - first_particle);
}
