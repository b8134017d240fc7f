// An order of particles in which neighbours have similar positions and headings. Their rays then read the same cells
// and have similar lengths, so work-items wait less for each other. The order changes no result.
// requires: ray

// Sampled particles.
#define SAMPLES 256
// Units of a turn.
#define TURN ((real)65536)

// Return the heading relative to the first particle's, from -TURN / 2 to TURN / 2.
int relative_turn(const real4 pose, const real4 other) {
    const real2 heading = (real2)(pose.z * other.z + pose.w * other.w, pose.w * other.z - pose.z * other.w);
    const int turn = (int)(turn_of(heading.x, heading.y) * TURN);
    return 2 * turn > (int)TURN ? turn - (int)TURN : turn;
}

// Clear the bins and find the bounds: one work-item takes a bin, and the first SAMPLES of them a particle each. bounds,
// which the caller sets to -2^31, become the negated smallest and the largest row, column and heading of these
// particles; the last one becomes 0.
kernel void order_bounds(ARGUMENTS) {
    const int bin = get_global_id(0);
    if (bin >= ALL_BINS) return;
    bins[bin] = 0;
    if (bin == 0) bounds[6] = 0;
    if (bin >= SAMPLES) return;
    const int n = (int)((long)bin * particles / SAMPLES);
    const int turn = relative_turn(pose[n], pose[0]);
    atomic_max(&bounds[0], -pose_cell[n].y);
    atomic_max(&bounds[1], pose_cell[n].y);
    atomic_max(&bounds[2], -pose_cell[n].x);
    atomic_max(&bounds[3], pose_cell[n].x);
    atomic_max(&bounds[4], -turn);
    atomic_max(&bounds[5], turn);
}

// Return the index of one of BINS equal parts of the bounds; values beyond them belong to the outermost parts.
int part_of(const int value, const int least, const int most) {
    const real part = ((real)value - (real)least) * ((real)BINS / ((real)most - (real)least + 1));
    return part < 0 ? 0 : part >= BINS ? BINS - 1 : (int)part;
}

// Find the bin of each particle, and count it there. One work-item takes a particle.
kernel void order_count(ARGUMENTS) {
    const int n = get_global_id(0);
    if (n >= particles) return;
    const int row = part_of(pose_cell[n].y, -bounds[0], bounds[1]);
    const int col = part_of(pose_cell[n].x, -bounds[2], bounds[3]);
    const int turn = part_of(relative_turn(pose[n], pose[0]), -bounds[4], bounds[5]);
    const int bin = (row * BINS + col) * BINS + turn;
    bin_of[n] = bin;
    atomic_add(&bins[bin], 1);
}

// Replace the counts of bins by the indices at which they begin. One work-item takes a stretch of neighbouring bins.
kernel void order_starts(ARGUMENTS) {
    const int stretch = get_global_id(0);
    if (stretch >= ALL_BINS / STRETCH) return;
    global int *counted = bins + stretch * STRETCH;
    // All are read before any is used, so that a work-item waits once for them.
    int counts[STRETCH], sum = 0;
#pragma unroll
    for (int i = 0; i < STRETCH; ++i) counts[i] = counted[i];
#pragma unroll
    for (int i = 0; i < STRETCH; ++i) sum += counts[i];
    int start = atomic_add(&bounds[6], sum);
#pragma unroll
    for (int i = 0; i < STRETCH; ++i) {
        counted[i] = start;
        start += counts[i];
    }
}

// Put each particle at the next index of its bin. One work-item takes a particle.
kernel void order_fill(ARGUMENTS) {
    const int n = get_global_id(0);
    if (n >= particles) return;
    order[atomic_add(&bins[bin_of[n]], 1)] = n;
}
