// Densities of positions and headings for LANES particles at once: absolute.cl in lanes, with the functions of
// lanes/math.
// requires: lanes/log_terms

// in lanes: HALF_TURN HALF_TURN_LOW

// The power series of the sine, as in absolute.cl; float32 needs no more terms up to pi / 2.
#define SINES 7
constant float SINE[SINES] = {
    -0.16666666666666666f, 0.008333333333333333f, -0.0001984126984126984f, 2.7557319223985893e-06f,
    -2.505210838544172e-08f, 1.6059043836821613e-10f, -7.647163731819816e-13f,
};

LanePair half_sine_lanes(const LanePair residual) {
    const lanes high = 0.5f * residual.x, low = 0.5f * residual.y, z = high * high;
    lanes series = 0;
    for (int i = SINES - 1; i >= 0; --i) series = series * z + SINE[i];
    return two_sum_lanes(high, low + high * (z * series));
}

INLINE lanes log_position_lanes(const LaneQuad off, global const PositionTerms *terms);
INLINE lanes log_heading_lanes(const LanePair r, global const HeadingTerms *terms, global const real *waves, const int kind);

// in lanes: log_other_turns log_waves log_position log_heading

// Score positions: one work-item takes LANES particles. Missing particles repeat the last one.
kernel void score_position(ARGUMENTS) {
    const int first = LANES * get_global_id(0);
    if (first >= particles) return;
    const lanes found = temperature * log_position_lanes(load_places(place, first, particles), terms);
    store_some(found, log_p + first, particles - first);
}

// Score headings: one work-item takes LANES particles. Missing particles repeat the last one.
kernel void score_heading(ARGUMENTS) {
    const int first = LANES * get_global_id(0);
    if (first >= particles) return;
    const LanePair r = load_pairs((global const real *)(residual + first), particles - first);
    store_some(temperature * log_heading_lanes(r, terms, waves, kind), log_p + first, particles - first);
}
