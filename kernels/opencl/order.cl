// An order of particles in which neighbours have much the same position and heading: then their rays meet the same
// cells, and none waits long for another. Which order it is changes no result.
// requires: ray

// Samples of the particles; bins of rows, of columns and of headings; work-items that count starts.
#define SAMPLES 256
#define BINS 32
#define ALL_BINS (BINS * BINS * BINS)
#define STRETCH 16
// Parts of a turn.
#define TURN ((real)65536)

// Heading relative to the first particle's, from -TURN / 2 to TURN / 2.
int relative_turn(const real4 pose, const real4 other) {
    const real2 heading = (real2)(pose.z * other.z + pose.w * other.w, pose.w * other.z - pose.z * other.w);
    const int turn = (int)(turn_of(heading) * TURN);
    return 2 * turn > (int)TURN ? turn - (int)TURN : turn;
}

// One work-item a bin, which it empties; some of them look at a particle each. bounds, which the caller sets to
// -2^31, become the largest of minus the smallest and the largest row, column and heading of those, and last 0.
kernel void order_bounds(global const int2 *pose_cell, global const real4 *pose, global int *bounds, global int *bins,
                         const int particles) {
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

// Which of BINS equal parts of the bounds; what is beyond them belongs to the outermost.
int part_of(const int value, const int least, const int most) {
    const real part = ((real)value - (real)least) * ((real)BINS / ((real)most - (real)least + 1));
    return part < 0 ? 0 : part >= BINS ? BINS - 1 : (int)part;
}

// One work-item a particle: its bin, which counts it.
kernel void order_count(global const int2 *pose_cell, global const real4 *pose, global const int *bounds,
                        global int *bins, global int *bin_of, const int particles) {
    const int n = get_global_id(0);
    if (n >= particles) return;
    const int row = part_of(pose_cell[n].y, -bounds[0], bounds[1]);
    const int col = part_of(pose_cell[n].x, -bounds[2], bounds[3]);
    const int turn = part_of(relative_turn(pose[n], pose[0]), -bounds[4], bounds[5]);
    const int bin = (row * BINS + col) * BINS + turn;
    bin_of[n] = bin;
    atomic_add(&bins[bin], 1);
}

// One work-item a stretch of bins, which lie together: from how many particles each has to where they begin.
kernel void order_starts(global int *bounds, global int *bins) {
    const int stretch = get_global_id(0);
    if (stretch >= ALL_BINS / STRETCH) return;
    global int *counted = bins + stretch * STRETCH;
    // All are read before any is added, so that a work-item waits once for them.
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

// One work-item a particle: it takes the next place of its bin.
kernel void order_fill(global const int *bin_of, global int *bins, global int *order, const int particles) {
    const int n = get_global_id(0);
    if (n >= particles) return;
    order[atomic_add(&bins[bin_of[n]], 1)] = n;
}
