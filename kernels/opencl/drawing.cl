// Resampling of particles from exact cumulative weights, with jitter between stages and injected poses; see the
// reference.
// requires: motion

#define LEAST_WEIGHT 1e-6

// Return the first index whose cumulative weight exceeds a mark.
int found_at(global const double *ends, const double mark, const int particles) {
    int low = 0, high = particles - 1;
    while (low < high) {
        const int middle = low + (high - low) / 2;
        if (ends[middle] > mark) high = middle;
        else low = middle + 1;
    }
    return low;
}

// Return the deterministic copies of residual resampling: the integer part of the expected number of copies.
double copies_of(global const double *ends, const double total, const int drawn, const int n) {
    const double weight = ends[n] - (n > 0 ? ends[n - 1] : 0.0);
    return total > 0.0 ? floor((double)drawn * weight / total) : 0.0;
}

// Return the first index whose cumulative residual weight exceeds a fraction of all residual weights.
int found_residual(global const double *ends, global const double *copies, const double fraction, const double total,
                   const int particles, const int drawn) {
    const double each = total / (double)drawn;
    const double mark = fraction * (ends[particles - 1] - copies[particles - 1] * each);
    int low = 0, high = particles - 1;
    while (low < high) {
        const int middle = low + (high - low) / 2;
        if (ends[middle] - copies[middle] * each > mark) high = middle;
        else low = middle + 1;
    }
    return low;
}

// Return the mark at a fraction of the total, clamped to below the total.
double mark_of(const double fraction, const double total) {
    const double mark = floor(fraction * total);
    return mark < total - 1.0 ? mark : total - 1.0;
}

// Return whether particles are copied, because no resampling is due.
int is_copied(global const double *own, const int particles, const int drawn) {
    return (own[RESAMPLED] == 0.0 && drawn == particles) || !(own[TOTAL] > 0.0);
}

// Copy particle n with its weight, relative to the mean weight.
void copy_particle(global const double *source, global const double *weight, global const double *settings,
                   global const double *own, global double *target, global double *after, const int particles,
                   const int n) {
    const long place = 3 * (long)n, from = 3 * (long)(n % particles);
    for (int axis = 0; axis < 3; axis++) target[place + axis] = source[from + axis];
    const double total = own[TOTAL];
    const double old = weight[n % particles], relative = old / (total / (settings[SCALE] * (double)particles));
    const double kept = old > 0.0 ? (relative > LEAST_WEIGHT ? relative : LEAST_WEIGHT) : 0.0;
    after[n] = total > 0.0 ? kept : 1.0;
}

// Return the random words of a draw in a stream of its stage.
uint4 words_of(global const double *settings, const int stage, const uint index, const uint stream) {
    const uint4 counter = (uint4)(index, (uint)settings[STEP], DRAW_STREAM + DRAW_STREAMS * stage + stream, 0);
    return random_words(counter, (uint)settings[SEED], (uint)settings[SEED + 1]);
}

// Return the random number of a draw's mark; systematic resampling uses the number of index 0 for all draws.
double start_of(global const double *settings, const int stage, const uint index) {
    return uniform_of(words_of(settings, stage, index, 0).x);
}

// Draw particle n from the one with index chosen: move it by jitter where a stage follows, or inject a pose.
void draw_particle(global const double *source, global const double *ends, global const double *settings,
                   global const double *state, global const double *pool, global double *target,
                   global double *after, const int particles, const int stage, const int n, const int chosen) {
    const long place = 3 * (long)n, from = 3 * (long)chosen;
    double x = source[from], y = source[from + 1], theta = source[from + 2];
    after[n] = 1.0;
    if (state[stage * STAGE + LEFT] > 0.0) {
        const double total = state[stage * STAGE + TOTAL];
        const uint4 words = words_of(settings, stage, n, 1);
        const long one = 3 * (long)found_at(ends, mark_of(uniform_of(words.x), total), particles);
        const long other = 3 * (long)found_at(ends, mark_of(uniform_of(words.y), total), particles);
        const double dx = source[one] - source[other], dy = source[one + 1] - source[other + 1];
        const double turn = wrap_once(source[one + 2] - source[other + 2]);
        const double far_x = fmax(fabs(dx), fabs(dy)) / settings[FARTHEST_X];
        const double far = fmax(fmax(far_x, fabs(turn) / settings[FARTHEST_THETA]), 1.0);
        const double part = settings[JITTER] / far;
        x += part * dx, y += part * dy, theta = wrap_once(theta + part * turn);
    }
    if (stage == 0 && state[INJECTED] > 0.0 && settings[POOL] > 0.0) {
        const uint4 words = words_of(settings, stage, n, 2);
        const uint4 more = words_of(settings, stage, n, 3);
        if (uniform_of(words.x) < state[INJECTED]) {
            const double row = floor(uniform_of(words.y) * settings[POOL]);
            const long held = 3 * (long)(row < settings[POOL] - 1.0 ? row : settings[POOL] - 1.0);
            x = pool[held] + (2.0 * uniform_of(more.x) - 1.0) * settings[POOL + 1];
            y = pool[held + 1] + (2.0 * uniform_of(more.y) - 1.0) * settings[POOL + 2];
            theta = wrap_once(pool[held + 2] + (2.0 * uniform_of(more.z) - 1.0) * settings[POOL + 3]);
        }
    }
    target[place] = x, target[place + 1] = y, target[place + 2] = theta;
}

// Count the deterministic copies of a block; the other columns are 0: one work-item takes a block.
kernel void count_copies(ARGUMENTS) {
    const int b = get_global_id(0), begin = b * block;
    if (begin >= particles) return;
    const double total = state[stage * STAGE + TOTAL];
    const int end = min(begin + block, particles);
    double sum = 0.0;
    for (int n = begin; n < end; n++) sum += copies_of(ends, total, drawn, n);
    global double *row = sums + (long)b * WEIGHT_SUMS;
    for (int k = 0; k < WEIGHT_SUMS; k++) row[k] = k == 0 ? sum : 0.0;
}

// Set the cumulative numbers of deterministic copies: one work-item takes a block.
kernel void set_copies(ARGUMENTS) {
    const int b = get_global_id(0), begin = b * block;
    if (begin >= particles) return;
    const double total = state[stage * STAGE + TOTAL];
    const int end = min(begin + block, particles);
    double sum = sums[(long)b * WEIGHT_SUMS] + (b < fan ? 0.0 : joined[(long)(b / fan) * WEIGHT_SUMS]);
    for (int n = begin; n < end; n++) {
        sum += copies_of(ends, total, drawn, n);
        copies[n] = sum;
    }
}

// Draw the particles of the next stage or step, or copy them where no resampling is due: one work-item takes a particle.
kernel void draw_particles(ARGUMENTS) {
    const int n = get_global_id(0);
    if (n >= drawn) return;
    global const double *own = state + stage * STAGE;
    if (is_copied(own, particles, drawn)) {
        copy_particle(source, weight, settings, own, target, after, particles, n);
        return;
    }
    const double start = start_of(settings, stage, settings[STRATIFIED] > 0.0 ? n : 0);
    const double at = (double)n;
    int chosen;
    if (settings[STRATIFIED] == RESIDUAL) {
        chosen = at < copies[particles - 1] ? found_at(copies, at, particles)
                                            : found_residual(ends, copies, start, own[TOTAL], particles, drawn);
    } else {
        chosen = found_at(ends, mark_of((at + start) / (double)drawn, own[TOTAL]), particles);
    }
    draw_particle(source, ends, settings, state, pool, target, after, particles, stage, n, chosen);
}
