// Probability of contact from the distance of a robot's outline to the nearest obstacle; see the reference.
// requires: error_free end_point log_terms

#define NO_OBSTACLE 0x7fffffff
// Gap in cells where there is no obstacle.
#define FAR_CELLS ((real)1e9)
#define LOG_TWO_ROOT_PI ((real)1.2655121234846454)
#define LARGE ((real)(FLOAT64 ? 10 : 6))
#define SERIES 12

// Return the gap between outline and obstacle, negative where they overlap; the squared distance is in cells.
real2 gap(const integer squared, global const ContactTerms *terms) {
    const real2 whole = two_sum(to_real(squared >> 12) * 4096, to_real(squared & 4095));
    const real d = sqrt(whole.x);
    const real2 dd = two_product(d, d);
    const real low = d > 0 ? ((whole.x - dd.x) + (whole.y - dd.y)) / (2 * d) : (real)0;
    const real2 cells = where_pair(squared == NO_OBSTACLE, (real2)(FAR_CELLS, 0), (real2)(d, low));
    const real2 away = pair_product(cells, (real2)(terms->side, terms->side_low));
    const real2 left = two_sum(away.x, -terms->reach);
    return two_sum(left.x, left.y + (away.y - terms->reach_low));
}

// Return log(erfc(x) / 2), by an asymptotic series where erfc nearly underflows.
real log_above(const real2 x) {
    if (!(x.x > LARGE)) return log((real)0.5 * erfc(x.x));
    const real t = (real)0.5 / (x.x * x.x);
    real series = 1;
    for (int n = SERIES; n > 0; --n) series = 1 - (2 * n - 1) * t * series;
    const real2 square = bounded_square(x);
    return -square.x - (log(x.x) + LOG_TWO_ROOT_PI - log(series) + square.y);
}

// Return the log probability that a segment is pressed, or that it is not.
real log_bump(const int squared, const int pressed, global const ContactTerms *terms) {
    const real2 x = pair_product(gap(squared, terms), (real2)(terms->scale, terms->scale_low));
    const real touching = log_above(x), clear = log_above(-x);
    const real hit = pressed ? terms->log_contact : terms->log_missed;
    const real no_hit = pressed ? terms->log_false : terms->log_quiet;
    return either(hit + touching, no_hit + clear);
}

// Sum log p over segments: one work-item takes a particle. Points start[s] to start[s + 1] - 1 belong to segment s;
// pressed[s] is not 0 where it is pressed.
kernel void score_contact(ARGUMENTS) {
    const int n = get_global_id(0);
    if (n >= particles) return;
    const int2 cell = pose_cell[n];
    const real4 sensor_pose = pose[n];
#if TWO_PART_POINTS
    const real4 low = pose_low[n];
#else
    const real4 low = 0;
#endif
    real total = 0;
    for (int s = 0; s < segments; ++s) {
        int nearest = NO_OBSTACLE;
        for (int i = start[s]; i < start[s + 1]; ++i) {
            const int2 at = cell + end_point(sensor_pose, low, point[i], point_low[i], (real)0, guard).cell;
            nearest = min(nearest, table[field_cell(at.x, at.y, window)]);
        }
        total += log_bump(nearest, pressed[s], terms);
    }
    log_p[n] = temperature * total;
}
