// Likelihood of a set of features for each particle, log p(f | x, m): the sum over features, book tables 6.4 and 6.5.
// requires: error_free landmarks landmark_grid

// Sum log p over features: with the KNOWN partner, all landmarks (MARGINAL) or the likeliest one. One work-item takes a
// particle. PER_BEAM: parts has the term of each feature, and which the index of its likeliest landmark, -1 where a
// false positive is likelier. share is log(1 / landmarks), the prior of a landmark, if MARGINAL, else 0.
kernel void score_features(ARGUMENTS) {
    const int n = get_global_id(0);
    if (n >= particles) return;
    const real4 high = pose[n], low = pose_low[n], place = sensor_place(pose_cell[n], high, low, buckets.size);
    real2 total = (real2)(score.constant_term, 0);
    int impossible = isinf(score.constant_term);
    for (int first = 0; first < features; first += BLOCK_TERMS) {
        const int last = min(first + BLOCK_TERMS, features);
        real block = 0;
        for (int k = first; k < last; ++k) {
            global const real *numbers = feature + FEATURE * k;
            const real4 turned = direction(high, low, numbers);
#if KNOWN
            const int j = partner[k];
            const real4 off = offset(landmark[j], place);
            const real detected = log_match(off, turned, numbers, normal, signature, j, terms, arcs);
            const Match match = {detected, detected, j};
#else
            const Match match =
                search(landmark, normal, signature, start, place, turned, numbers, terms, arcs, buckets);
#endif
            const real value = either(match.log_p + share, numbers[FALSE_POSITIVE]);
            impossible |= isinf(value);
            block += isinf(value) ? (real)0 : value;
#if PER_BEAM
            parts[(long)n * features + k] = value;
#if KNOWN
            which[(long)n * features + k] = j;
#else
            which[(long)n * features + k] = match.best + share >= numbers[FALSE_POSITIVE] ? match.chosen : -1;
#endif
#endif
        }
        total = add_term(total, block);
    }
    log_p[n] = impossible ? -INFINITY : score.temperature * (total.x + total.y);
}
