// Weights of particles from the log-likelihoods of sensors, at the highest temperature that leaves enough particles.
// w_k = v exp(b_k (l - max l)), where v is the weight before, l the sum over sensors of temperature times log p, and b_k
// = b / 2^k a ladder. The first rung with an effective sample size (sum w)^2 / sum w^2 of at least SHARE of that before
// is taken; what is left of b belongs to the next stage of the correction (annealing: Neal, "Annealed importance
// sampling", 2001). Weights are rounded to integers below 2^53 / N, so that sums of them are exact in any order.
// Recovery: augmented MCL, "Probabilistic Robotics" table 8.3, with the mean likelihood per beam.
// requires: elementary

#define SHARE 19
#define THRESHOLD 20
#define SCALE 21
#define PER_BEAM_SCALE 22
#define SLOW_RATE 23
#define FAST_RATE 24
#define MOST_INJECTED 25
#define TEMPERATURE 27
#define RUNGS 8
#define WEIGHT_SUMS (2 * RUNGS + 1)
// Places in the state: of a stage, and of what lasts.
#define LEFT 0
#define TOTAL 1
#define SAMPLE_SIZE 2
#define RESAMPLED 3
#define DEGENERATE 4
#define RUNG 5
#define STAGE 8
#define EVIDENCE 48
#define SLOW 49
#define FAST 50
#define INJECTED 51

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

// Return the largest score of all blocks.
double largest_of(global const double *largest, const int blocks) {
    double high = -INFINITY;
    for (int b = 0; b < blocks; b++) high = largest[b] > high ? largest[b] : high;
    return high;
}

// Return the likelihood of a score relative to the largest; 1 where none is possible or nothing is left.
double tempered(const double score, const double largest, const double left) {
    return largest == -INFINITY || left == 0.0 ? 1.0 : exp_of(left * (score - largest));
}

// Return the part of the temperature that earlier stages have left.
double left_of(global const double *state, const int stage) {
    return stage > 0 ? state[(stage - 1) * STAGE + LEFT] : 1.0;
}

// Sum the integer weights of each block on each rung, their squares, and the weights before: one work-item takes a block.
kernel void weigh_particles(global const double *score, global const double *before, global const double *largest,
                            global const double *settings, global const double *state, global double *sums,
                            const int particles, const int block, const int blocks, const int stage) {
    const int b = get_global_id(0), begin = b * block;
    if (begin >= particles) return;
    const double high = largest_of(largest, blocks), left = left_of(state, stage), scale = settings[SCALE];
    const int end = min(begin + block, particles);
    // A vector of RUNGS numbers: processors compute four or eight of them at once.
    double8 weights = 0.0, squares = 0.0;
    double old = 0.0;
    for (int n = begin; n < end; n++) {
        double8 likelihood;
        likelihood.s0 = tempered(score[n], high, left);
        likelihood.s1 = sqrt(likelihood.s0);
        likelihood.s2 = sqrt(likelihood.s1);
        likelihood.s3 = sqrt(likelihood.s2);
        likelihood.s4 = sqrt(likelihood.s3);
        likelihood.s5 = sqrt(likelihood.s4);
        likelihood.s6 = sqrt(likelihood.s5);
        likelihood.s7 = sqrt(likelihood.s6);
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

// Add up the sums of all blocks: one work-item takes a column. At stage 0 the first follows the evidence.
kernel void sum_weights(global const double *sums, global const double *largest, global const double *settings,
                        global double *state, global double *totals, const int blocks, const int stage) {
    const int column = get_global_id(0);
    if (column >= WEIGHT_SUMS) return;
    double total = 0.0, before = 0.0;
    for (int b = 0; b < blocks; b++) {
        total += sums[(long)b * WEIGHT_SUMS + column];
        before += sums[(long)b * WEIGHT_SUMS + 2 * RUNGS];
    }
    totals[column] = total;
    if (stage == 0 && column == 0) follow_evidence(total, before, largest_of(largest, blocks), settings, state);
}

// Return the first rung with the effective sample size least, or the last rung.
int rung_of(global const double *totals, global const double *settings, const double least) {
    int rung = 0;
    while (rung < RUNGS - 1 && !(totals[rung] * totals[rung] >= least * settings[SCALE] * totals[RUNGS + rung])) rung++;
    return rung;
}

// Choose the rung, and set the weights and their exact cumulative sums: one work-item takes a block. The first writes the
// stage's state.
kernel void set_weights(global const double *score, global const double *before, global const double *largest,
                        global const double *sums, global const double *totals, global const double *settings,
                        global double *state, global double *weight, global double *ends, const int particles,
                        const int block, const int blocks, const int stage, const int stages) {
    const int b = get_global_id(0), begin = b * block;
    if (begin >= particles) return;
    const double scale = settings[SCALE], left = left_of(state, stage), high = largest_of(largest, blocks);
    const int rung = left > 0.0 ? rung_of(totals, settings, settings[SHARE] * (double)particles) : 0;
    const int end = min(begin + block, particles);
    double sum = 0.0;
    for (int i = 0; i < b; i++) sum += sums[(long)i * WEIGHT_SUMS + rung];
    for (int n = begin; n < end; n++) {
        double likelihood = tempered(score[n], high, left);
        for (int k = 0; k < rung; k++) likelihood = sqrt(likelihood);
        const double chosen = before[n] * likelihood;
        weight[n] = chosen;
        sum += floor(chosen * scale);
        ends[n] = sum;
    }
    if (b > 0) return;
    const double size = totals[rung] * totals[rung] / (scale * totals[RUNGS + rung]);
    double part = left;
    for (int k = 0; k < rung; k++) part *= 0.5;
    const double rest = left - part;
    const int wanted = size < settings[THRESHOLD] * (double)particles || rest > 0.0 ||
                       (stage == 0 && state[INJECTED] > 0.0);
    global double *own = state + stage * STAGE;
    own[LEFT] = stage + 1 < stages ? rest : 0.0;
    own[TOTAL] = totals[rung];
    own[SAMPLE_SIZE] = size;
    own[RESAMPLED] = wanted ? 1.0 : 0.0;
    own[DEGENERATE] = high == -INFINITY ? 1.0 : 0.0;
    own[RUNG] = part;
}
