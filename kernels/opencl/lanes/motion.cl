// Sampled motions of 8 particles at once: motion.cl.
// requires: lanes/philox

// in lanes: SMALL_ARC WHOLE_TURN FARTHEST_ONCE angle_of Motion chord_of wrap_once wrap_any motion_of move_by

// Move the particles from begin on, at most DOUBLES of them.
void move_lanes(global const double *source, global const double *settings, global double *target, const int begin,
                const int count, const int kind) {
    const uint step = (uint)settings[STEP], key_0 = (uint)settings[SEED], key_1 = (uint)settings[SEED + 1];
    const ulong8 indices = (ulong)begin + (ulong8)(0, 1, 2, 3, 4, 5, 6, 7);
    ulong8 words[4];
    random_words_lanes(indices, step, MOTION_STREAM, key_0, key_1, words);
    Motion_lanes motion = motion_of_lanes(normal_pair_lanes(words[0], words[1]), normal_pair_lanes(words[2], words[3]),
                                          settings, kind);
    if (settings[REVERSE] > 0.0) {
        random_words_lanes(indices, step, MOTION_STREAM + 1, key_0, key_1, words);
        motion.ahead = uniform_of_lanes(words[0]) < settings[REVERSE] ? -motion.ahead : motion.ahead;
    }
    doubles x, y, theta;
    load_poses(source, begin, count, &x, &y, &theta);
    move_by_lanes(motion, &x, &y, &theta);
    store_poses(x, y, theta, target, begin, count);
}

// A work-item takes LANES particles.
kernel void move_particles(ARGUMENTS) {
    const int first = LANES * get_global_id(0), last = min(first + LANES, particles);
    for (int begin = first; begin < last; begin += DOUBLES)
        move_lanes(source, settings, target, begin, min(DOUBLES, last - begin), kind);
}
