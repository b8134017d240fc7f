// Weights of particles from the log-likelihoods of sensors, at the highest temperature that leaves enough particles.
// w_k = v exp(b_k (l - max l)), where v is the weight before, l the sum over sensors of temperature times log p, and b_k
// = b / 2^k a ladder. The first rung with an effective sample size (sum w)^2 / sum w^2 of at least SHARE of that before
// is taken; what is left of b belongs to the next stage of the correction (annealing: Neal, "Annealed importance
// sampling", 2001). Weights are rounded to integers below 2^53 / N, so that sums of them are exact in any order.
// requires: rungs

// Add a sensor's log-likelihoods times its temperature to the scores, which sensor 0 begins, and find the largest: one
// work-item takes a block of particles.
kernel void add_scores(global const real *log_p, global const double *settings, global double *score,
                       global double *largest, const int particles, const int block, const int sensor) {
    const int b = get_global_id(0), begin = b * block;
    if (begin >= particles) return;
    const double temperature = settings[TEMPERATURE + sensor];
    const int end = min(begin + block, particles);
    double high = -INFINITY;
    for (int n = begin; n < end; n++) {
        const double scaled = temperature * (double)log_p[n];
        const double sum = sensor == 0 ? scaled : score[n] + scaled;
        score[n] = sum;
        high = sum > high ? sum : high;
    }
    largest[b] = high;
}

// Find the largest score of each fan blocks: one work-item takes a group of blocks.
kernel void join_scores(global const double *scores, global double *largest, const int blocks, const int fan) {
    const int g = get_global_id(0), begin = g * fan;
    if (begin >= blocks) return;
    largest[g] = largest_of(scores + begin, min(fan, blocks - begin));
}

// Sum the integer weights of each block on each rung, their squares, and the weights before: one work-item takes a block.
kernel void weigh_particles(global const double *score, global const double *before, global const double *largest,
                            global const double *settings, global const double *state, global double *sums,
                            const int particles, const int block, const int blocks, const int groups,
                            const int stage) {
    const int b = get_global_id(0), begin = b * block;
    if (begin >= particles) return;
    const double high = largest_of(largest, groups), left = left_of(state, stage), scale = settings[SCALE];
    const int end = min(begin + block, particles);
    // A vector of RUNGS numbers: processors compute four or eight of them at once.
    double8 weights = 0.0, squares = 0.0;
    double old = 0.0;
    for (int n = begin; n < end; n++) {
        double8 likelihood;
        likelihood.s7 = tempered(score[n], high, left);
        likelihood.s6 = likelihood.s7 * likelihood.s7;
        likelihood.s5 = likelihood.s6 * likelihood.s6;
        likelihood.s4 = likelihood.s5 * likelihood.s5;
        likelihood.s3 = likelihood.s4 * likelihood.s4;
        likelihood.s2 = likelihood.s3 * likelihood.s3;
        likelihood.s1 = likelihood.s2 * likelihood.s2;
        likelihood.s0 = likelihood.s1 * likelihood.s1;
        old += floor(before[n] * scale);
        const double8 weight = before[n] * likelihood;
        weights += floor(weight * scale);
        squares += floor(weight * weight * scale);
    }
    global double *row = sums + (long)b * WEIGHT_SUMS;
    vstore8(weights, 0, row);
    vstore8(squares, 0, row + RUNGS);
    row[2 * RUNGS] = old;
}

// Add up each fan rows of sums, one after the other: one work-item takes a column of a group of rows.
kernel void join_rows(global const double *sums, global double *joined, const int rows, const int columns,
                      const int fan) {
    const int i = get_global_id(0), begin = i / columns * fan, end = min(begin + fan, rows);
    if (begin >= rows) return;
    double total = 0.0;
    for (int row = begin; row < end; row++) total += sums[(long)row * columns + i % columns];
    joined[i] = total;
}

// Choose the rung, and set the weights and their exact cumulative sums: one work-item takes a block. The first
// writes the stage's state.
kernel void set_weights(global const double *score, global const double *before, global const double *largest,
                        global const double *sums, global const double *joined, global const double *totals,
                        global const double *settings, global double *state, global double *weight,
                        global double *ends, const int particles, const int block, const int blocks, const int fan,
                        const int groups, const int stage, const int stages) {
    const int b = get_global_id(0), begin = b * block;
    if (begin >= particles) return;
    const double scale = settings[SCALE], left = left_of(state, stage);
    const double high = possible_of(totals, largest_of(largest, groups));
    const int rung = left > 0.0 ? rung_of(totals, settings, settings[SHARE] * (double)particles) : 0;
    const int end = min(begin + block, particles), column = column_of(high, rung);
    double sum = 0.0;
    for (int g = 0; g < b / fan; g++) sum += joined[(long)g * WEIGHT_SUMS + column];
    for (int i = b - b % fan; i < b; i++) sum += sums[(long)i * WEIGHT_SUMS + column];
    for (int n = begin; n < end; n++) {
        double likelihood = tempered(score[n], high, left);
        for (int k = rung; k < RUNGS - 1; k++) likelihood *= likelihood;
        const double chosen = before[n] * likelihood;
        weight[n] = chosen;
        sum += floor(chosen * scale);
        ends[n] = sum;
    }
    if (b == 0) set_stage(totals, settings, state, high, left, rung, particles, stage, stages);
}
