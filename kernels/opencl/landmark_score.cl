// Likelihood of a set of features for each particle, log p(f | x, m): the sum over features, book tables 6.4 and 6.5;
// and negative information: landmarks that the sensor should see from a pose, but that match no feature.
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

// Return whether a landmark is within range and, with a FIELD, the cosine of its angle to the sensor's axis is at least
// ``least``.
int in_view(const real4 off, const real cosine, const real sine, const real range_max, const real least) {
    const real d = sqrt(off.x * off.x + off.z * off.z);
#if FIELD
    return d <= range_max && cosine * off.x + sine * off.z >= least * d;
#else
    return d <= range_max;
#endif
}

// Add log_missed to log_p for every landmark in view that belongs to no feature. One work-item takes a particle.
kernel void count_unseen(ARGUMENTS) {
    const int n = get_global_id(0);
    if (n >= particles) return;
    const real4 sensor_pose = pose[n], place = sensor_place(pose_cell[n], sensor_pose, pose_low[n], buckets.size);
    const real cosine = sensor_pose.z * view.axis_cosine - sensor_pose.w * view.axis_sine;
    const real sine = sensor_pose.w * view.axis_cosine + sensor_pose.z * view.axis_sine;
    const int left = bucket_at(place.x - view.range_max, buckets.size, buckets.cols);
    const int right = bucket_at(place.x + view.range_max, buckets.size, buckets.cols);
    const int high = bucket_at(place.z + view.range_max, buckets.size, buckets.rows);
    int unseen = 0;
    for (int row = bucket_at(place.z - view.range_max, buckets.size, buckets.rows); row <= high; ++row) {
        const int last = start[row * buckets.cols + right + 1];
        for (int j = start[row * buckets.cols + left]; j < last; ++j) {
            if (!in_view(offset(landmark[j], place), cosine, sine, view.range_max, view.least)) continue;
            int taken = 0;
            for (int k = 0; k < features; ++k) taken |= which[(long)n * features + k] == j;
            unseen += !taken;
        }
    }
    if (unseen > 0) log_p[n] += unseen * view.log_missed;
}
