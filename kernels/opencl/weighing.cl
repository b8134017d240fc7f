// Weights of particles from the log-likelihoods of sensors, at the highest temperature that leaves enough particles;
// see the reference.
// requires: elementary

// Return 8 numbers from first on, and missing in place of those from end on: a work-item waits once for all of them.
double8 eight_at(global const double *values, const int first, const int end, const double missing) {
    const int count = end - first;
    values += first;
    return (double8)(count > 0 ? values[0] : missing, count > 1 ? values[1] : missing, count > 2 ? values[2] : missing,
                     count > 3 ? values[3] : missing, count > 4 ? values[4] : missing, count > 5 ? values[5] : missing,
                     count > 6 ? values[6] : missing, count > 7 ? values[7] : missing);
}

// Sum of integers over a block; in lanes, a sum per lane.
typedef double Total;

// Return the sum of 8 numbers, rounded down to integers.
Total sum_eight(const double8 numbers) {
    const double8 a = floor(numbers);
    return a.s0 + a.s1 + a.s2 + a.s3 + a.s4 + a.s5 + a.s6 + a.s7;
}

// Return the number that a sum is.
double sum_of(const Total total) { return total; }

// Write 8 weights from first on and their cumulative sums; return the sum of all so far.
double write_eight(const double8 weights, const double scale, const double before, global double *weight,
                   global double *ends, const int first, const int end) {
    const double8 whole = floor(weights * scale);
    double sum = before;
#pragma unroll
    for (int i = 0; i < 8; i++) {
        sum += ((const double *)&whole)[i];
        if (first + i < end) weight[first + i] = ((const double *)&weights)[i], ends[first + i] = sum;
    }
    return sum;
}

// Return the largest of the scores from begin to before end.
double largest_of(global const double *largest, const int begin, const int end) {
    double8 high = -INFINITY;
    for (int g = begin; g < end; g += 16) {
        const double8 one = eight_at(largest, g, end, -INFINITY), two = eight_at(largest, g + 8, end, -INFINITY);
        const double8 higher = one > two ? one : two;
        high = higher > high ? higher : high;
    }
    const double4 four = high.lo > high.hi ? high.lo : high.hi;
    const double2 two = four.lo > four.hi ? four.lo : four.hi;
    return two.x > two.y ? two.x : two.y;
}

// Return the largest score; -inf if all particles with a weight are impossible next to particles without.
double possible_of(global const double *totals, const double largest) {
    return totals[RUNGS - 1] > 0.0 ? largest : -INFINITY;
}

// Return the column of sums with the weights of a rung; the column of the previous weights where none is possible.
int column_of(const double high, const int rung) {
    return high == -INFINITY ? 2 * RUNGS : rung;
}

// Return the sum of a column over all blocks before one: over the blocks before it in its group, and over the groups
// before it.
double sum_before(global const double *sums, global const double *joined, const int b, const int fan, const int column) {
    const double before = sums[(long)b * WEIGHT_SUMS + column];
    return b < fan ? before : before + joined[(long)(b / fan) * WEIGHT_SUMS + column];
}

// Return the likelihoods of 8 scores relative to the largest, on the last rung; 1 where none is possible or nothing is
// left. Their squares belong to the rung before: an error of 2^-53 grows to 2^-46 on the first rung.
double8 tempered(const double8 scores, const double largest, const double left) {
    if (largest == -INFINITY || left == 0.0) return 1.0;
    const double8 a = LOWEST * left * (scores - largest);
    return (double8)(exp_of(a.s0), exp_of(a.s1), exp_of(a.s2), exp_of(a.s3), exp_of(a.s4), exp_of(a.s5), exp_of(a.s6),
                     exp_of(a.s7));
}

// Return the part of the temperature that earlier stages have left.
double left_of(global const double *state, const int stage) {
    return stage > 0 ? state[(stage - 1) * STAGE + LEFT] : 1.0;
}

// Return the first rung with the effective sample size least, or the last rung.
int rung_of(global const double *totals, global const double *settings, const double least) {
    int rung = RUNGS - 1;
    for (int k = RUNGS - 2; k >= 0; k--) {
        if (totals[k] * totals[k] >= least * settings[SCALE] * totals[RUNGS + k]) rung = k;
    }
    return rung;
}

// Update the averages of the likelihood per beam, and the share of particles to inject.
void follow_evidence(const double total, const double before, const double largest, global const double *settings,
                     global double *state) {
    if (largest == -INFINITY || !(total > 0.0) || !(before > 0.0)) return;
    const double evidence = largest + log_of(total / before);
    const double scaled = settings[PER_BEAM_SCALE] * evidence;
    const double mean = exp_of(scaled < 700.0 ? scaled : 700.0);
    const int first = state[SLOW] == 0.0;
    const double slow = first ? mean : state[SLOW] + settings[SLOW_RATE] * (mean - state[SLOW]);
    const double fast = first ? mean : state[FAST] + settings[FAST_RATE] * (mean - state[FAST]);
    const double share = slow > 0.0 ? 1.0 - fast / slow : 0.0;
    const double least = share > 0.0 ? share : 0.0;
    state[EVIDENCE] = evidence, state[SLOW] = slow, state[FAST] = fast;
    state[INJECTED] = least < settings[MOST_INJECTED] ? least : settings[MOST_INJECTED];
}

// Write the state of a stage that uses a rung; at stage 0, follow the evidence of the whole temperature.
void set_stage(global const double *totals, global const double *settings, global double *state, const double high,
               const double left, const int rung, const int particles, const int stage, const int stages) {
    if (stage == 0 && settings[DEPTH] == 1.0) follow_evidence(totals[0], totals[2 * RUNGS], high, settings, state);
    const double size = totals[rung] * totals[rung] / (settings[SCALE] * totals[RUNGS + rung]);
    double part = left * settings[DEPTH];
    for (int k = 0; k < rung; k++) part *= 0.5;
    const double rest = left - part;
    const int wanted = size < settings[THRESHOLD] * (double)particles || rest > 0.0 ||
                       (stage == 0 && state[INJECTED] > 0.0);
    global double *own = state + stage * STAGE;
    own[LEFT] = stage + 1 < stages ? rest : 0.0;
    own[TOTAL] = totals[column_of(high, rung)];
    own[SAMPLE_SIZE] = size;
    own[RESAMPLED] = wanted ? 1.0 : 0.0;
    own[DEGENERATE] = high == -INFINITY ? 1.0 : 0.0;
    own[RUNG] = part;
}

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
