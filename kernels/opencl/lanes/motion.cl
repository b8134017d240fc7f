// Sampled motions of 8 particles at once: motion.cl.
// requires: lanes/philox

#define SEED 0
#define STEP 2
#define MEAN 3
#define DEVIATION 7
#define REVERSE 11
#define FIRST 61
#define MOTION_STREAM 0
#define VELOCITY_MODEL 1
#define SMALL_ARC 1e-4
#define WHOLE_TURN 6.283185307179586
#define FARTHEST_ONCE 9.424777960769378

// Return the chords of arcs that turn by twice half_turn.
doubles chord_of_lanes(const doubles length, const doubles half_turn) {
    doubles cosine, sine;
    cos_sin_lanes(half_turn, &cosine, &sine);
    const choices small = (half_turn < SMALL_ARC) & (half_turn > -SMALL_ARC);
    const doubles turn = small ? (doubles)1.0 : half_turn;
    return small ? length * (1.0 - half_turn * half_turn / 6.0) : length * (sine / turn);
}

// Wrap headings that are less than a turn outside [-pi, pi] to that interval.
doubles wrap_once_lanes(const doubles theta) {
    return theta > HALF_TURN ? theta - WHOLE_TURN : theta < -HALF_TURN ? theta + WHOLE_TURN : theta;
}

// Wrap any headings to [-pi, pi]; those more than a turn outside it one by one, by their cosines and sines.
doubles wrap_any_lanes(const doubles theta) {
    const choices far = (theta > FARTHEST_ONCE) | (theta < -FARTHEST_ONCE);
    doubles wrapped = wrap_once_lanes(theta);
    if (!any(far)) return wrapped;
    for (int lane = 0; lane < DOUBLES; lane++) {
        const double one = ((const double *)&theta)[lane];
        if (!(fabs(one) > FARTHEST_ONCE)) continue;
        const double2 turn = cos_sin(one);
        ((double *)&wrapped)[lane] = angle_of(turn.x, turn.y);
    }
    return wrapped;
}

// Move the particles from begin on, at most DOUBLES of them.
void move_lanes(global const double *source, global const double *settings, global double *target, const int begin,
                const int count, const int kind) {
    const uint step = (uint)settings[STEP], key_0 = (uint)settings[SEED], key_1 = (uint)settings[SEED + 1];
    const uint index = (uint)settings[FIRST] + (uint)begin;
    const ulong8 indices = ((ulong)index + (ulong8)(0, 1, 2, 3, 4, 5, 6, 7)) & 0xFFFFFFFFUL;
    ulong8 words[4];
    random_words_lanes(indices, step, MOTION_STREAM, key_0, key_1, words);
    doubles one, other, two, another;
    normal_pair_lanes(words[0], words[1], &one, &other);
    normal_pair_lanes(words[2], words[3], &two, &another);
    const doubles first = settings[MEAN] + settings[DEVIATION] * one;
    doubles ahead = settings[MEAN + 1] + settings[DEVIATION + 1] * other;
    const doubles left = settings[MEAN + 2] + settings[DEVIATION + 2] * two;
    doubles second = settings[MEAN + 3] + settings[DEVIATION + 3] * another;
    if (kind == VELOCITY_MODEL) {
        ahead = chord_of_lanes(ahead, first);
        second = first + second;
    }
    if (settings[REVERSE] > 0.0) {
        random_words_lanes(indices, step, MOTION_STREAM + 1, key_0, key_1, words);
        ahead = uniform_of_lanes(words[0]) < settings[REVERSE] ? -ahead : ahead;
    }
    doubles x, y, before;
    load_poses(source, begin, count, &x, &y, &before);
    const doubles theta = before + first;
    doubles cosine, sine;
    cos_sin_lanes(theta, &cosine, &sine);
    const doubles to_x = x + (ahead * cosine - left * sine), to_y = y + (ahead * sine + left * cosine);
    const doubles turned = wrap_any_lanes(theta + second);
    store_poses(to_x, to_y, turned, target, begin, count);
}

// A work-item takes LANES particles.
kernel void move_particles(ARGUMENTS) {
    const int first = LANES * get_global_id(0), last = min(first + LANES, particles);
    for (int begin = first; begin < last; begin += DOUBLES)
        move_lanes(source, settings, target, begin, min(DOUBLES, last - begin), kind);
}
