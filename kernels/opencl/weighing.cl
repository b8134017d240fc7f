// Weights of particles from the log-likelihoods of sensors, at the highest temperature that leaves enough particles.
// w_k = v exp(b_k (l - max l)), where v is the previous weight, l the sum over sensors of temperature times log p, and
// b_k = d b / 2^k a ladder of depth d. The first rung whose effective sample size (sum w)^2 / sum w^2 is at least SHARE
// of the previous one is taken; the rest of b is left to the next stage of the correction (annealing: Neal, "Annealed
// importance sampling", 2001). Weights are rounded to integers below 2^53 / N, so that their sums are exact in any
// order.
// requires: tempering

// Rows that a work-item reads before it adds any up.
#define ROWS_AT_ONCE 16

// Add a sensor's log-likelihoods times its temperature to the scores, which sensor 0 begins, and find the largest: one
// work-item takes a block of particles.
kernel void add_scores(ARGUMENTS) {
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

// Find the largest score of each group of fan blocks: one work-item takes a group of blocks.
kernel void join_scores(ARGUMENTS) {
    const int g = get_global_id(0), begin = g * fan;
    if (begin >= blocks) return;
    largest[g] = largest_of(scores, begin, min(begin + fan, blocks));
}

// Sum the integer weights of each block on each rung, their squares, and the previous weights: one work-item takes a
// block. The first one writes the largest score.
kernel void weigh_particles(ARGUMENTS) {
    const int b = get_global_id(0), begin = b * block;
    if (begin >= particles) return;
    const double high = largest_of(largest, 0, groups), left = left_of(state, stage) * settings[DEPTH];
    const double scale = settings[SCALE];
    const int end = min(begin + block, particles);
    Total weights[RUNGS], squares[RUNGS], old = 0.0;
    for (int k = 0; k < RUNGS; k++) weights[k] = squares[k] = 0.0;
    for (int n = begin; n < end; n += 8) {
        const double8 scores = eight_at(score, n, end, -INFINITY), prior = eight_at(before, n, end, 0.0);
        double8 likelihood = tempered(scores, high, left);
        old += sum_eight(prior * scale);
#pragma unroll
        for (int k = RUNGS - 1; k >= 0; k--) {
            const double8 weight = prior * likelihood;
            weights[k] += sum_eight(weight * scale);
            squares[k] += sum_eight(weight * weight * scale);
            likelihood *= likelihood;
        }
    }
    global double *row = sums + (long)b * WEIGHT_SUMS;
    for (int k = 0; k < RUNGS; k++) row[k] = sum_of(weights[k]), row[RUNGS + k] = sum_of(squares[k]);
    row[2 * RUNGS] = sum_of(old);
    if (b == 0) highest[0] = high;
}

// Add up groups of fan rows of sums in order; a row becomes the sum of the rows before it in its group: one work-item
// takes a column of a group.
kernel void join_rows(ARGUMENTS) {
    const int i = get_global_id(0), begin = i / columns * fan, end = min(begin + fan, rows);
    if (begin >= rows) return;
    global double *column = sums + i % columns;
    double total = 0.0;
    for (int row = begin; row < end; row += ROWS_AT_ONCE) {
        double number[ROWS_AT_ONCE];
#pragma unroll
        for (int k = 0; k < ROWS_AT_ONCE; k++) number[k] = row + k < end ? column[(long)(row + k) * columns] : 0.0;
#pragma unroll
        for (int k = 0; k < ROWS_AT_ONCE; k++) {
            if (row + k < end) column[(long)(row + k) * columns] = total;
            total += number[k];
        }
    }
    joined[i] = total;
}

// Choose the rung, and set the weights and their exact cumulative sums: one work-item takes a block. The one after the
// last block writes the stage's state.
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
    for (int n = begin; n < end; n += 8) {
        const double8 scores = eight_at(score, n, end, -INFINITY), prior = eight_at(before, n, end, 0.0);
        double8 likelihood = tempered(scores, high, low);
        for (int k = rung; k < RUNGS - 1; k++) likelihood *= likelihood;
        sum = write_eight(prior * likelihood, scale, sum, weight, ends, n, end);
    }
}
