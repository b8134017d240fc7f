// Likelihood of a set of features for LANES particles at once: score_features of landmark_score.cl. Sums have the order
// of the scalar kernel.
// requires: lanes/landmark_grid

// Sum log p over features: one work-item takes LANES particles. Missing particles repeat the last one.
kernel void score_features(ARGUMENTS) {
    const int first_particle = LANES * get_global_id(0);
    if (first_particle >= particles) return;
    real p[8][LANES];
    for (int i = 0; i < LANES; ++i) {
        const int n = min(first_particle + i, particles - 1);
        const real4 high = pose[n], low = pose_low[n], place = sensor_place(pose_cell[n], high, low, buckets.size);
        p[0][i] = place.x, p[1][i] = place.y, p[2][i] = place.z, p[3][i] = place.w;
        p[4][i] = high.z, p[5][i] = low.z, p[6][i] = high.w, p[7][i] = low.w;
    }
    const LanePlace place = {{load_lanes(0, p[0]), load_lanes(0, p[1])}, {load_lanes(0, p[2]), load_lanes(0, p[3])}};
    const LanePlace heading = {{load_lanes(0, p[4]), load_lanes(0, p[5])}, {load_lanes(0, p[6]), load_lanes(0, p[7])}};
    LanePair total = {(lanes)score.constant_term, (lanes)0};
    ilanes impossible = isinf(score.constant_term) ? -1 : 0;
    for (int first = 0; first < features; first += BLOCK_TERMS) {
        const int last = min(first + BLOCK_TERMS, features);
        lanes block = 0;
        for (int k = first; k < last; ++k) {
            global const real *numbers = feature + FEATURE * k;
            const LanePlace turned = direction_lanes(heading, numbers);
#if KNOWN
            const int j = partner[k];
#if SIGNATURE
            const real4 known = signature[j];
#else
            const real4 known = 0;
#endif
            const lanes detected =
                log_detection_lanes(offset_lanes(landmark[j], place), turned, numbers, known, terms);
#else
            const MatchLanes match =
                search_lanes(landmark, signature, start, place, turned, numbers, terms, buckets);
            const lanes detected = match.log_p + share;
#endif
            const lanes value = either_lanes(detected, (lanes)numbers[FALSE_POSITIVE]);
#if PER_BEAM
#if KNOWN
            const ilanes chosen = j;
#else
            const ilanes chosen = match.best + share >= numbers[FALSE_POSITIVE] ? match.chosen : (ilanes)-1;
#endif
            for (int i = 0; i < LANES && first_particle + i < particles; ++i) {
                const long at = (long)(first_particle + i) * features + k;
                parts[at] = ((const real *)&value)[i];
                which[at] = ((const int *)&chosen)[i];
            }
#endif
            const ilanes zero = !(value > -INFINITY);
            impossible |= zero;
            block += zero ? (lanes)0 : value;
        }
        const LanePair sum = two_sum_lanes(total.hi, block);
        total = (LanePair){sum.hi, total.lo + sum.lo};
    }
    const lanes all = impossible ? (lanes)-INFINITY : score.temperature * (total.hi + total.lo);
    store_some(all, log_p + first_particle, particles - first_particle);
}
