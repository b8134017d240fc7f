// Weights of 8 particles at once: weighing.cl. Sums of integer weights are exact in any order.
// requires: tempering lanes/elementary

// Return the likelihoods of scores relative to the largest on the last rung; 1 where none is possible or nothing is left.
doubles tempered_lanes(const doubles score, const double largest, const double left) {
    return largest == -INFINITY || left == 0.0 ? (doubles)1.0 : exp_of_lanes(LOWEST * left * (score - largest));
}

// A work-item takes a block; the first one writes the largest score.
kernel void weigh_particles(ARGUMENTS) {
    const int b = get_global_id(0), begin = b * block;
    if (begin >= particles) return;
    const double high = largest_of(largest, 0, groups), left = left_of(state, stage) * settings[DEPTH];
    const double scale = settings[SCALE];
    const int end = min(begin + block, particles);
    doubles weights[RUNGS], squares[RUNGS], old = 0.0;
    for (int k = 0; k < RUNGS; k++) weights[k] = squares[k] = 0.0;
    for (int n = begin; n < end; n += DOUBLES) {
        const int count = min(DOUBLES, end - n);
        doubles likelihood = tempered_lanes(load_doubles(score, n, count), high, left);
        // Lanes without a particle have no weight.
        const choices there = (choices)(0, 1, 2, 3, 4, 5, 6, 7) < (long)count;
        const doubles prior = there ? load_doubles(before, n, count) : (doubles)0.0;
        old += floor_lanes(prior * scale);
        for (int k = RUNGS - 1; k >= 0; k--) {
            const doubles weight = prior * likelihood;
            weights[k] += floor_lanes(weight * scale);
            squares[k] += floor_lanes(weight * weight * scale);
            likelihood *= likelihood;
        }
    }
    global double *row = sums + (long)b * WEIGHT_SUMS;
    for (int k = 0; k < RUNGS; k++) row[k] = sum_doubles(weights[k]), row[RUNGS + k] = sum_doubles(squares[k]);
    row[2 * RUNGS] = sum_doubles(old);
    if (b == 0) highest[0] = high;
}

// A work-item takes a block, and adds up its weights in the order of the particles. The one after the last block writes
// the stage's state.
kernel void set_weights(ARGUMENTS) {
    const int b = get_global_id(0), begin = b * block;
    if (b > blocks) return;
    const double scale = settings[SCALE], left = left_of(state, stage), high = possible_of(totals, highest[0]);
    const int rung = left > 0.0 ? rung_of(totals, settings, settings[SHARE] * (double)particles) : 0;
    if (b == blocks) {
        set_stage(totals, settings, state, high, left, rung, particles, stage, stages);
        return;
    }
    const int end = min(begin + block, particles);
    const double low = left * settings[DEPTH];
    double sum = sum_before(sums, joined, b, fan, column_of(high, rung));
    for (int n = begin; n < end; n += DOUBLES) {
        const int count = min(DOUBLES, end - n);
        doubles likelihood = tempered_lanes(load_doubles(score, n, count), high, low);
        for (int k = rung; k < RUNGS - 1; k++) likelihood *= likelihood;
        const doubles chosen = load_doubles(before, n, count) * likelihood, whole = floor_lanes(chosen * scale);
        store_doubles(chosen, weight, n, count);
        doubles upto;
        for (int i = 0; i < DOUBLES; i++) {
            sum += i < count ? ((const double *)&whole)[i] : 0.0;
            ((double *)&upto)[i] = sum;
        }
        store_doubles(upto, ends, n, count);
    }
}
