// Resampling of particles from exact cumulative weights, with jitter between stages and injected poses.
// Systematic resampling draws at (n + u) / N of the total, stratified resampling at (n + u_n) / N: "Probabilistic
// Robotics" table 4.4, and Kitagawa (1996). Between two stages of a correction a drawn pose moves by a fraction of the
// difference of two others, whose spread is that of the cloud (differential evolution: ter Braak 2006); differences
// between separate clusters are shortened. Injected poses come from a pool: free cells, or the modes of a likelihood map.
// requires: motion

#define JITTER 12
#define FARTHEST_X 13
#define FARTHEST_THETA 14
#define POOL 15
#define SCALE 21
#define STRATIFIED 26
#define WHOLE 62
#define DRAWN 63
#define LEFT 0
#define TOTAL 1
#define RESAMPLED 3
#define STAGE 8
#define INJECTED 51
#define DRAW_STREAM 16
#define DRAW_STREAMS 4
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

// Return the mark at a fraction of the total, below the total.
double mark_of(const double fraction, const double total) {
    const double mark = floor(fraction * total);
    return mark < total - 1.0 ? mark : total - 1.0;
}

// Draw the particles of the next stage or step, or copy them where no resampling is due: one work-item takes a particle.
kernel void draw_particles(global const double *source, global const double *weight, global const double *ends,
                           global const double *settings, global const double *state, global const double *pool,
                           global double *target, global double *after, const int particles, const int drawn,
                           const int stage) {
    const int n = get_global_id(0);
    if (n >= drawn) return;
    const long place = 3 * (long)n;
    global const double *own = state + stage * STAGE;
    const double total = own[TOTAL];
    if ((own[RESAMPLED] == 0.0 && drawn == particles) || !(total > 0.0)) {
        const long from = 3 * (long)(n % particles);
        for (int axis = 0; axis < 3; axis++) target[place + axis] = source[from + axis];
        const double whole = settings[WHOLE] > 0.0 ? settings[WHOLE] : (double)particles;
        const double old = weight[n % particles], relative = old / (total / (settings[SCALE] * whole));
        const double kept = old > 0.0 ? (relative > LEAST_WEIGHT ? relative : LEAST_WEIGHT) : 0.0;
        after[n] = total > 0.0 ? kept : 1.0;
        return;
    }
    const uint step = (uint)settings[STEP], key_0 = (uint)settings[SEED], key_1 = (uint)settings[SEED + 1];
    const uint stream = DRAW_STREAM + DRAW_STREAMS * stage;
    const uint index = (uint)settings[FIRST] + (uint)n, first = settings[STRATIFIED] > 0.0 ? index : 0;
    const double whole = settings[DRAWN] > 0.0 ? settings[DRAWN] : (double)drawn;
    const double start = uniform_of(random_words((uint4)(first, step, stream, 0), key_0, key_1).x);
    const long chosen = 3 * (long)found_at(ends, mark_of(((double)index + start) / whole, total), particles);
    double x = source[chosen], y = source[chosen + 1], theta = source[chosen + 2];
    after[n] = 1.0;
    if (own[LEFT] > 0.0) {
        const uint4 words = random_words((uint4)(index, step, stream + 1, 0), key_0, key_1);
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
        const uint4 words = random_words((uint4)(index, step, stream + 2, 0), key_0, key_1);
        const uint4 more = random_words((uint4)(index, step, stream + 3, 0), key_0, key_1);
        if (uniform_of(words.x) < state[INJECTED]) {
            const double row = floor(uniform_of(words.y) * settings[POOL]);
            const long from = 3 * (long)(row < settings[POOL] - 1.0 ? row : settings[POOL] - 1.0);
            x = pool[from] + (2.0 * uniform_of(more.x) - 1.0) * settings[POOL + 1];
            y = pool[from + 1] + (2.0 * uniform_of(more.y) - 1.0) * settings[POOL + 2];
            theta = wrap_once(pool[from + 2] + (2.0 * uniform_of(more.z) - 1.0) * settings[POOL + 3]);
        }
    }
    target[place] = x, target[place + 1] = y, target[place + 2] = theta;
}
