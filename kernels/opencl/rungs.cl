// The ladder of temperatures of a correction, and the state of its stages: b_k = b / 2^k, where b is what earlier stages
// have left. See weighing.cl.
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
// 2^-(RUNGS - 1).
#define LOWEST 0.0078125
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

// Return the largest score of all groups.
double largest_of(global const double *largest, const int groups) {
    double high = -INFINITY;
    for (int g = 0; g < groups; g++) high = largest[g] > high ? largest[g] : high;
    return high;
}

// Return the largest score; -inf where all particles with a weight are impossible next to those without one.
double possible_of(global const double *totals, const double largest) {
    return totals[RUNGS - 1] > 0.0 ? largest : -INFINITY;
}

// Return the column of sums with the weights of a rung; that of the weights before where none is possible.
int column_of(const double high, const int rung) {
    return high == -INFINITY ? 2 * RUNGS : rung;
}

// Return the likelihood of a score relative to the largest, on the last rung; 1 where none is possible or nothing is
// left. Its square belongs to the rung before: an error of 2^-53 grows to 2^-46 on the first rung.
double tempered(const double score, const double largest, const double left) {
    return largest == -INFINITY || left == 0.0 ? 1.0 : exp_of(LOWEST * left * (score - largest));
}

// Return the part of the temperature that earlier stages have left.
double left_of(global const double *state, const int stage) {
    return stage > 0 ? state[(stage - 1) * STAGE + LEFT] : 1.0;
}

// Return the first rung with the effective sample size least, or the last rung.
int rung_of(global const double *totals, global const double *settings, const double least) {
    int rung = 0;
    while (rung < RUNGS - 1 && !(totals[rung] * totals[rung] >= least * settings[SCALE] * totals[RUNGS + rung])) rung++;
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

// Write the state of a stage that uses a rung; at stage 0, follow the evidence.
void set_stage(global const double *totals, global const double *settings, global double *state, const double high,
               const double left, const int rung, const int particles, const int stage, const int stages) {
    if (stage == 0) follow_evidence(totals[0], totals[2 * RUNGS], high, settings, state);
    const double size = totals[rung] * totals[rung] / (settings[SCALE] * totals[RUNGS + rung]);
    double part = left;
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
