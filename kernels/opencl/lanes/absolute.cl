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

// in lanes: log_other_turns log_waves

// Score positions: one work-item takes LANES particles. Missing particles repeat the last one.
kernel void score_position(ARGUMENTS) {
    const int first_particle = LANES * get_global_id(0);
    if (first_particle >= particles) return;
    const LaneQuad offset = load_places(place, first_particle, particles);
    const LanePair x = {offset.x, offset.y}, y = {offset.z, offset.w};
    const LanePair x_scale = {terms->x_scale, terms->x_scale_low}, y_scale = {terms->y_scale, terms->y_scale_low};
    const LanePair shear = {terms->shear, terms->shear_low};
    const LanePair first = bounded_square_lanes(pair_product_lanes(x, x_scale));
    const LanePair second =
        bounded_square_lanes(pair_sum_lanes(pair_product_lanes(x, shear), pair_product_lanes(y, y_scale)));
    const LanePair exponent = pair_sum_lanes(first, second);
    lanes log_density = (terms->peak - exponent.x) + (terms->peak_low - exponent.y);
#if RAND
    log_density = either_lanes(log_density, (lanes)terms->random);
#endif
    store_some(temperature * log_density, log_p + first_particle, particles - first_particle);
}

// Score headings: one work-item takes LANES particles. Missing particles repeat the last one.
kernel void score_heading(ARGUMENTS) {
    const int first_particle = LANES * get_global_id(0);
    if (first_particle >= particles) return;
    const LanePair r = load_pairs((global const real *)(residual + first_particle), particles - first_particle);
    lanes log_density;
    if (kind == SERIES) {
        log_density = terms->peak + (terms->peak_low + log_waves_lanes(r, waves));
    } else {
        const LanePair root = kind == VON_MISES ? half_sine_lanes(r) : r;
        const LanePair scale = {terms->scale, terms->scale_low};
        const LanePair exponent = bounded_square_lanes(pair_product_lanes(root, scale));
        log_density = (terms->peak - exponent.x) + (terms->peak_low - exponent.y);
        if (kind == NEARBY) log_density += log_other_turns_lanes(r, terms->decay);
    }
#if RAND
    log_density = either_lanes(log_density, (lanes)terms->random);
#endif
    store_some(temperature * log_density, log_p + first_particle, particles - first_particle);
}
