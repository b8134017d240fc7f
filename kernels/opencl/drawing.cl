// Resampling of particles from exact cumulative weights, with jitter between stages and injected poses.
// Systematic resampling draws at (n + u) / N of the total, stratified resampling at (n + u_n) / N: "Probabilistic
// Robotics" table 4.4, and Kitagawa (1996). Between two stages of a correction a drawn pose moves by a fraction of the
// difference of two others, whose spread is that of the cloud (differential evolution: ter Braak 2006); differences
// between separate clusters are shortened. Injected poses come from a pool: free cells, or the modes of a likelihood map.
// requires: draws

// Draw the particles of the next stage or step, or copy them where no resampling is due: one work-item takes a particle.
kernel void draw_particles(global const double *source, global const double *weight, global const double *ends,
                           global const double *settings, global const double *state, global const double *pool,
                           global double *target, global double *after, const int particles, const int drawn,
                           const int stage) {
    const int n = get_global_id(0);
    if (n >= drawn) return;
    global const double *own = state + stage * STAGE;
    if (is_copied(own, particles, drawn)) {
        copy_particle(source, weight, settings, own, target, after, particles, n);
        return;
    }
    const uint index = (uint)settings[FIRST] + (uint)n;
    const double start = start_of(settings, stage, settings[STRATIFIED] > 0.0 ? index : 0);
    const double whole = settings[DRAWN] > 0.0 ? settings[DRAWN] : (double)drawn;
    const double mark = mark_of(((double)index + start) / whole, own[TOTAL]);
    const int chosen = found_at(ends, mark, particles);
    draw_particle(source, ends, settings, state, pool, target, after, particles, stage, n, chosen);
}
