// Draws of LANES neighbours with ascending marks: the first is searched, and the others are found by walking on from
// it. See drawing.cl.
// requires: lanes/types drawing

// A work-item takes LANES particles.
kernel void draw_particles(ARGUMENTS) {
    const int first = LANES * get_global_id(0), last = min(first + LANES, drawn);
    global const double *own = state + stage * STAGE;
    const int copied = is_copied(own, particles, drawn), stratified = settings[STRATIFIED] > 0.0;
    const int residual = settings[STRATIFIED] == RESIDUAL;
    double start = start_of(settings, stage, 0);
    int chosen = 0;
    for (int n = first; n < last; n++) {
        if (copied) {
            copy_particle(source, weight, settings, own, target, after, particles, n);
            continue;
        }
        if (stratified) start = start_of(settings, stage, n);
        const double at = (double)n;
        if (residual) {
            chosen = at < copies[particles - 1]
                         ? found_at(copies, at, particles)
                         : found_residual(ends, copies, start, own[TOTAL], particles, drawn);
        } else {
            const double mark = mark_of((at + start) / (double)drawn, own[TOTAL]);
            if (n == first) chosen = found_at(ends, mark, particles);
            while (chosen < particles - 1 && !(ends[chosen] > mark)) chosen++;
        }
        draw_particle(source, ends, settings, state, pool, target, after, particles, stage, n, chosen);
    }
}
