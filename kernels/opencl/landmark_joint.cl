// The likeliest joint association of a few features, in which no two features have the same landmark. Features without
// a landmark are false positives. Landmarks are processed one after the other. A set s of features is a bit mask;
// best[s] is the largest sum of log p over the features of s when all of them have landmarks that were processed. A
// landmark can add one feature to a set: 2^features * features steps per landmark, and the maximum is exact.
// requires: error_free landmarks landmark_grid

// Largest number of features.
#define MOST_FEATURES 8

// Find the best joint association: one work-item takes a particle. choice[s] has the landmark of each feature of set s,
// and value[s] its log p; sets is 2^features.
kernel void joint_features(global const real4 *landmark, global const real4 *signature, global const int2 *pose_cell,
                           global const real4 *pose, global const real4 *pose_low, global const real *feature,
                           global const real *terms, global const real2 *arcs, global real *best, global int *choice,
                           global real *value, global real *log_p, global real *parts, global int *which,
                           const int landmarks, const int particles, const int features, const int sets,
                           const Buckets buckets, const Score score) {
    const int n = get_global_id(0);
    if (n >= particles) return;
    const real4 high = pose[n], low = pose_low[n], place = sensor_place(pose_cell[n], high, low, buckets.size);
    global real *sums = best + (long)n * sets, *each = value + (long)n * sets * features;
    global int *who = choice + (long)n * sets * features;
    for (int s = 0; s < sets; ++s) sums[s] = s == 0 ? (real)0 : -INFINITY;
    for (int i = 0; i < sets * features; ++i) who[i] = -1, each[i] = -INFINITY;
    for (int j = 0; j < landmarks; ++j) {
        const real4 off = offset(landmark[j], place);
        real log_each[MOST_FEATURES];
        for (int k = 0; k < features; ++k) {
            global const real *numbers = feature + FEATURE * k;
            const real4 turned = direction(high, low, numbers);
            log_each[k] = -INFINITY;
            if (numbers[RADIUS] >= 0 && near(off, turned, numbers, INFINITY))
                log_each[k] = either(log_detection(off, turned, numbers, signature[j], terms, arcs),
                                     numbers[FALSE_POSITIVE]);
        }
        // From the full set down, since smaller sets must not yet contain this landmark.
        for (int s = sets - 1; s > 0; --s) {
            for (int k = 0; k < features; ++k) {
                if (!(s >> k & 1)) continue;
                const int less = s ^ 1 << k;
                const real joined = sums[less] + log_each[k];
                if (!(joined > sums[s])) continue;
                sums[s] = joined;
                for (int i = 0; i < features; ++i) {
                    who[s * features + i] = i == k ? j : who[less * features + i];
                    each[s * features + i] = i == k ? log_each[k] : each[less * features + i];
                }
            }
        }
    }
    real most = -INFINITY;
    int chosen = 0;
    for (int s = 0; s < sets; ++s) {
        real total = sums[s];
        for (int k = 0; k < features; ++k)
            if (!(s >> k & 1)) total += feature[FEATURE * k + FALSE_POSITIVE];
        if (total > most) most = total, chosen = s;
    }
    log_p[n] = isinf(most) ? most : score.temperature * (score.constant_term + most);
#if PER_BEAM
    for (int k = 0; k < features; ++k) {
        const int j = who[chosen * features + k];
        which[(long)n * features + k] = j;
        parts[(long)n * features + k] =
            j >= 0 ? each[chosen * features + k] : feature[FEATURE * k + FALSE_POSITIVE];
    }
#endif
}
