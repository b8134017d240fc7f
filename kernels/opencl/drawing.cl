// Resampling of particles from exact cumulative weights, with jitter between stages and injected poses. Systematic
// resampling draws at (n + u) / N of the total, stratified resampling at (n + u_n) / N: "Probabilistic Robotics" table
// 4.4, and Kitagawa (1996). Residual resampling copies each particle by the integer part of its expected number of
// copies, and draws the rest by the residual weights (Liu and Chen 1998). Between two stages of a correction a drawn
// pose moves by a fraction of the difference between two other poses, so that moves scale with the spread of the cloud
// (differential evolution: ter Braak 2006); differences between separate clusters are shortened. Injected poses come
// from a pool: free cells, or the modes of a likelihood map.
// requires: draws

#define WEIGHT_SUMS 17

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
