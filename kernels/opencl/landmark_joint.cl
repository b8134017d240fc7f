// The likeliest joint association of a few features, in which no two features of one group have the same landmark; see
// the reference.
// requires: error_free landmarks landmark_grid

// Largest number of features.
#define MOST_FEATURES 8
// A landmark's part of a density exceeds the false positive's if the density is more than twice the latter.
#define LOG_2 ((real)0.69314718055994531)

// Let landmark j be seen by one more feature of each set, at most one feature per group; log_each has the features' log
// p.
void add_landmark(const int j, const real *log_each, global const real *feature, global real *best, global int *choice,
                  global real *value, const int features, const int sets, const int groups) {
    // From the full set down, since smaller sets must not yet contain this landmark for the group.
    for (int step = 0; step < groups * (sets - 1); ++step) {
        const int group = step / (sets - 1), s = sets - 1 - step % (sets - 1);
        for (int k = 0; k < features; ++k) {
            if (!(s >> k & 1) || feature[FEATURE * k + GROUP] != group) continue;
            const int less = s ^ 1 << k;
            const real joined = best[less] + log_each[k];
            if (!(joined > best[s])) continue;
            best[s] = joined;
            for (int i = 0; i < features; ++i) {
                choice[s * features + i] = i == k ? j : choice[less * features + i];
                value[s * features + i] = i == k ? log_each[k] : value[less * features + i];
            }
        }
    }
}

// Return log p of all features if those of set s have landmarks and the remaining ones are false positives.
real set_total(const int s, const real sum, global const real *feature, const int features) {
    real total = sum;
    for (int k = 0; k < features; ++k)
        if (!(s >> k & 1)) total += feature[FEATURE * k + FALSE_POSITIVE];
    return total;
}

// Return the set with the largest log p, and write that.
int best_set(global const real *sums, global const real *feature, const int features, const int sets, real *most) {
    int chosen = 0;
    *most = -INFINITY;
    for (int s = 0; s < sets; ++s) {
        const real total = set_total(s, sums[s], feature, features);
        if (total > *most) *most = total, chosen = s;
    }
    return chosen;
}

// Find the best joint association: one work-item takes a particle. choice[s] has the landmark of each feature of set s,
// and value[s] its log p; sets is 2^features.
kernel void joint_features(ARGUMENTS) {
    const int n = get_global_id(0);
    if (n >= particles) return;
    const real4 high = pose[n], low = pose_low[n], place = sensor_place(pose_cell[n], high, low, buckets.size);
    global real *sums = best + (long)n * sets, *each = value + (long)n * sets * features;
    global int *who = choice + (long)n * sets * features;
    for (int s = 0; s < sets; ++s) sums[s] = s == 0 ? (real)0 : -INFINITY;
    for (int i = 0; i < sets * features; ++i) who[i] = -1, each[i] = -INFINITY;
    int groups = 1;
    for (int k = 0; k < features; ++k) groups = max(groups, (int)feature[FEATURE * k + GROUP] + 1);
    for (int j = 0; j < landmarks; ++j) {
        const real4 off = offset(landmark[j], place);
        real log_each[MOST_FEATURES];
        for (int k = 0; k < features; ++k) {
            global const real *numbers = feature + FEATURE * k;
            const real4 turned = direction(high, low, numbers);
            log_each[k] = -INFINITY;
            if (numbers[RADIUS] >= 0 && may_match(off, turned, numbers, normal, signature, j, INFINITY))
                log_each[k] = either(log_match(off, turned, numbers, normal, signature, j, terms, arcs),
                                     numbers[FALSE_POSITIVE]);
        }
        add_landmark(j, log_each, feature, sums, who, each, features, sets, groups);
    }
    real most;
    const int chosen = best_set(sums, feature, features, sets, &most);
    log_p[n] = isinf(most) ? most : score.temperature * (score.constant_term + most);
#if PER_BEAM
    for (int k = 0; k < features; ++k) {
        const real false_positive = feature[FEATURE * k + FALSE_POSITIVE], log_each = each[chosen * features + k];
        const int j = who[chosen * features + k];
        which[(long)n * features + k] = log_each - false_positive >= LOG_2 ? j : -1;
        parts[(long)n * features + k] = j >= 0 ? log_each : false_positive;
    }
#endif
}
