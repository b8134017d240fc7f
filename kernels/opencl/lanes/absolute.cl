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
    const lanes high = 0.5f * residual.hi, low = 0.5f * residual.lo, z = high * high;
    lanes series = 0;
    for (int i = SINES - 1; i >= 0; --i) series = series * z + SINE[i];
    return two_sum_lanes(high, low + high * (z * series));
}

lanes log_other_turns_lanes(const LanePair residual, const float decay) {
    const ilanes back = residual.hi < 0;
    const lanes size = back ? -residual.hi : residual.hi, low = back ? -residual.lo : residual.lo;
    lanes rest = (HALF_TURN - size) + (HALF_TURN_LOW - low);
    rest = rest > 0 ? rest : (lanes)0;
    const ilanes some = decay * rest <= NEGLIGIBLE;
    if (!any_lane(some)) return (lanes)0;
    lanes others = 0;
    for (int k = 1; k <= WRAPS; ++k) {
        others += exp_lanes(-decay * k * ((k - 1) * HALF_TURN + rest));
        others += exp_lanes(-decay * k * (k * HALF_TURN + size));
    }
    return some ? log_one_plus_lanes(others) : (lanes)0;
}

// in lanes: log_waves

// Score positions: one work-item takes LANES particles. Missing particles repeat the last one.
kernel void score_position(ARGUMENTS) {
    const int first_particle = LANES * get_global_id(0);
    if (first_particle >= particles) return;
    const LanePlace offset = load_places(place, first_particle, particles);
    const LanePair first = bounded_square_lanes(scaled_pair_lanes(offset.x, terms->x_scale, terms->x_scale_low));
    const LanePair sum = pair_sum_lanes(scaled_pair_lanes(offset.x, terms->shear, terms->shear_low),
                                        scaled_pair_lanes(offset.y, terms->y_scale, terms->y_scale_low));
    const LanePair exponent = pair_sum_lanes(first, bounded_square_lanes(sum));
    lanes log_density = (terms->peak - exponent.hi) + (terms->peak_low - exponent.lo);
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
        const LanePair exponent = bounded_square_lanes(scaled_pair_lanes(root, terms->scale, terms->scale_low));
        log_density = (terms->peak - exponent.hi) + (terms->peak_low - exponent.lo);
        if (kind == NEARBY) log_density += log_other_turns_lanes(r, terms->decay);
    }
#if RAND
    log_density = either_lanes(log_density, (lanes)terms->random);
#endif
    store_some(temperature * log_density, log_p + first_particle, particles - first_particle);
}
