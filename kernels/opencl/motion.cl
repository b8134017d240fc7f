// Sampled motions of particles: a first turn, a translation ahead and to the left, and a second turn; see the
// reference.
// requires: philox

#define SMALL_ARC 1e-4
#define WHOLE_TURN 6.283185307179586
// A full turn more than HALF_TURN, rounded down.
#define FARTHEST_ONCE 9.424777960769378

// A sampled motion: a first turn, a translation ahead and to the left, and a second turn.
typedef struct {
    double first, ahead, left, second;
} Motion;

// Return the chord of an arc that turns by twice half_turn.
double chord_of(const double length, const double half_turn) {
    const long small = (half_turn < SMALL_ARC) & (half_turn > -SMALL_ARC);
    const double turn = small ? 1.0 : half_turn;
    return small ? length * (1.0 - half_turn * half_turn / 6.0) : length * (cos_sin(half_turn).y / turn);
}

// Wrap headings that are less than a turn outside [-pi, pi] to that interval.
double wrap_once(const double theta) {
    return theta > HALF_TURN ? theta - WHOLE_TURN : theta < -HALF_TURN ? theta + WHOLE_TURN : theta;
}

// Return whether a comparison holds; in lanes, whether it holds in any.
int any_of(const long holds) { return holds != 0; }

// Wrap any heading to [-pi, pi]; headings more than a turn outside it by their cosine and sine.
double wrap_any(const double theta) {
    const long far = (theta > FARTHEST_ONCE) | (theta < -FARTHEST_ONCE);
    const double wrapped = wrap_once(theta);
    if (!any_of(far)) return wrapped;
    const double2 turn = cos_sin(theta);
    const double angle = angle_of(turn.x, turn.y);
    return far ? angle : wrapped;
}

// Return the motion for a standard normal deviate of each part.
Motion motion_of(const double2 one, const double2 two, global const double *settings, const int kind) {
    Motion motion;
    motion.first = settings[MEAN] + settings[DEVIATION] * one.x;
    motion.ahead = settings[MEAN + 1] + settings[DEVIATION + 1] * one.y;
    motion.left = settings[MEAN + 2] + settings[DEVIATION + 2] * two.x;
    motion.second = settings[MEAN + 3] + settings[DEVIATION + 3] * two.y;
    if (kind == VELOCITY_MODEL) {
        motion.ahead = chord_of(motion.ahead, motion.first);
        motion.second = motion.first + motion.second;
    }
    return motion;
}

// Move a particle.
void move_by(const Motion motion, double *x, double *y, double *theta) {
    const double turned = *theta + motion.first;
    const double2 heading = cos_sin(turned);
    *x = *x + (motion.ahead * heading.x - motion.left * heading.y);
    *y = *y + (motion.ahead * heading.y + motion.left * heading.x);
    *theta = wrap_any(turned + motion.second);
}

// Move particles from source to target, which may be the same array: one work-item takes a particle.
kernel void move_particles(ARGUMENTS) {
    const int n = get_global_id(0);
    if (n >= particles) return;
    const uint step = (uint)settings[STEP], key_0 = (uint)settings[SEED], key_1 = (uint)settings[SEED + 1];
    const uint4 words = random_words((uint4)((uint)n, step, MOTION_STREAM, 0), key_0, key_1);
    Motion motion = motion_of(normal_pair(words.x, words.y), normal_pair(words.z, words.w), settings, kind);
    if (settings[REVERSE] > 0.0) {
        const uint4 more = random_words((uint4)((uint)n, step, MOTION_STREAM + 1, 0), key_0, key_1);
        motion.ahead = uniform_of(more.x) < settings[REVERSE] ? -motion.ahead : motion.ahead;
    }
    const long place = 3 * (long)n;
    double x = source[place], y = source[place + 1], theta = source[place + 2];
    move_by(motion, &x, &y, &theta);
    target[place] = x, target[place + 1] = y, target[place + 2] = theta;
}
