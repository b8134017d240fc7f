// Probability of contact for LANES particles at once: contact.cl in lanes, with the functions of lanes/math. Cells of
// points have the bits of the scalar kernel.
// requires: lanes/end_point lanes/log_terms

// in lanes: NO_OBSTACLE FAR_CELLS SERIES LOG_TWO_ROOT_PI gap

#define LOG_TWO 0.693147181f
// From here on the series is accurate to float32.
#define LARGE 4.0f

// Return the numbers in the cells of one point of the outline. One near a cell's edge is computed again by end_point.
ilanes look_up_lanes(global const int *table, const Particles *particle, const real2 point, const real2 point_low,
                     global const int2 *pose_cell, global const real4 *pose, global const real4 *pose_low,
                     const int first, const int particles, const Window window, const real guard) {
    const lanes x = particle->x + (particle->cos * point.x - particle->sin * point.y);
    const lanes y = particle->y + (particle->sin * point.x + particle->cos * point.y);
    const ilanes to_col = floor_int_lanes(x), to_row = floor_int_lanes(y);
    const lanes left_x = x - to_lanes(to_col), left_y = y - to_lanes(to_row);
    const int stride = window.cols + 2 * FIELD_RING;
    const ilanes col = within_lanes(particle->col + to_col, stride - 1);
    const ilanes row = within_lanes(particle->row + to_row, window.rows + 2 * FIELD_RING - 1);
    ilanes index = row * stride + col;
    const ilanes near = (left_x < guard) | (left_y < guard) | (left_x > 1 - guard) | (left_y > 1 - guard);
    if (any_lane(near)) {
        for (int i = 0; i < LANES; ++i) {
            if (!((const int *)&near)[i]) continue;
            const int n = min(first + i, particles - 1);
            const int2 at = pose_cell[n] + end_point(pose[n], pose_low[n], point, point_low, 0, guard).cell;
            ((int *)&index)[i] = field_cell(at.x, at.y, window);
        }
    }
    return GATHER(ilanes, table, index);
}

// Return log(erfc(x) / 2) for x >= 0, by an asymptotic series where erfc is small.
lanes log_above_lanes(const LanePair x) {
    const ilanes large = x.x >= LARGE;
    const lanes b = large ? (lanes)LARGE : x.x;
    lanes above = log_erfc_lanes(b) - LOG_TWO;
    if (any_lane(large)) {
        const lanes t = 0.5f / (x.x * x.x);
        lanes series = 1;
        for (int n = SERIES; n > 0; --n) series = 1 - (2 * n - 1) * t * series;
        const LanePair square = bounded_square_lanes(x);
        const lanes far = -square.x - (log_lanes((large ? x.x : (lanes)1) / (large ? series : (lanes)1)) +
                                        (LOG_TWO_ROOT_PI + square.y));
        above = large ? far : above;
    }
    return above;
}

lanes log_bump_lanes(const ilanes squared, const int pressed, global const ContactTerms *terms) {
    const LanePair x = pair_product_lanes(gap_lanes(squared, terms), (LanePair){terms->scale, terms->scale_low});
    const ilanes overlaps = x.x < 0;
    // The smaller of the two probabilities, then the other one.
    const LanePair size = {overlaps ? -x.x : x.x, overlaps ? -x.y : x.y};
    const lanes small = log_above_lanes(size), large = log_lanes(1 - exp_lanes(small));
    const lanes touching = overlaps ? large : small, clear = overlaps ? small : large;
    const real hit = pressed ? terms->log_contact : terms->log_missed;
    const real no_hit = pressed ? terms->log_false : terms->log_quiet;
    return either_lanes(hit + touching, no_hit + clear);
}

// Sum log p over segments: one work-item takes LANES particles. Missing particles repeat the last one.
kernel void score_contact(ARGUMENTS) {
    const int first_particle = LANES * get_global_id(0);
    if (first_particle >= particles) return;
    Particles some;
    for (int i = 0; i < LANES; ++i) {
        const int n = min(first_particle + i, particles - 1);
        set_particle(&some, i, pose_cell[n], pose[n], 0, 1);
    }
    lanes total = 0;
    for (int s = 0; s < segments; ++s) {
        ilanes nearest = NO_OBSTACLE;
        for (int i = start[s]; i < start[s + 1]; ++i) {
            const ilanes squared = look_up_lanes(table, &some, point[i], point_low[i], pose_cell, pose, pose_low,
                                                 first_particle, particles, window, guard);
            nearest = squared < nearest ? squared : nearest;
        }
        total += log_bump_lanes(nearest, pressed[s], terms);
    }
    store_some(temperature * total, log_p + first_particle, particles - first_particle);
}
