// Sampled motions of particles: a first turn, a translation ahead and to the left, and a second turn.
// Odometry model: Thrun, Burgard and Fox, "Probabilistic Robotics" (2005), table 5.6; velocity model: table 5.3. Each
// of the four parts is normal, with a mean and a deviation in the settings. An arc of the velocity model
// (VELOCITY_MODEL) turns by twice the first part; its chord is the arc's length times sin(a) / a. With probability
// REVERSE the translation goes the other direction: some odometers count wheel turns without their sign.
// requires: philox

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
// A full turn more than HALF_TURN, rounded down.
#define FARTHEST_ONCE 9.424777960769378

// Return the chord of an arc that turns by twice half_turn.
double chord_of(const double length, const double half_turn) {
    if (fabs(half_turn) < SMALL_ARC) return length * (1.0 - half_turn * half_turn / 6.0);
    return length * (cos_sin(half_turn).y / half_turn);
}

// Wrap headings that are less than a turn outside [-pi, pi] to that interval.
double wrap_once(const double theta) {
    return theta > HALF_TURN ? theta - WHOLE_TURN : theta < -HALF_TURN ? theta + WHOLE_TURN : theta;
}

// Wrap any heading to [-pi, pi]; headings more than a turn outside it by their cosine and sine.
double wrap_any(const double theta) {
    if (!(fabs(theta) > FARTHEST_ONCE)) return wrap_once(theta);
    const double2 turn = cos_sin(theta);
    return angle_of(turn.x, turn.y);
}

// Move particles from source to target, which may be the same array: one work-item takes a particle.
kernel void move_particles(ARGUMENTS) {
    const int n = get_global_id(0);
    if (n >= particles) return;
    const uint step = (uint)settings[STEP], key_0 = (uint)settings[SEED], key_1 = (uint)settings[SEED + 1];
    const uint index = (uint)settings[FIRST] + (uint)n;
    const uint4 words = random_words((uint4)(index, step, MOTION_STREAM, 0), key_0, key_1);
    const double2 one = normal_pair(words.x, words.y), two = normal_pair(words.z, words.w);
    const double first = settings[MEAN] + settings[DEVIATION] * one.x;
    double ahead = settings[MEAN + 1] + settings[DEVIATION + 1] * one.y;
    const double left = settings[MEAN + 2] + settings[DEVIATION + 2] * two.x;
    double second = settings[MEAN + 3] + settings[DEVIATION + 3] * two.y;
    if (kind == VELOCITY_MODEL) {
        ahead = chord_of(ahead, first);
        second = first + second;
    }
    if (settings[REVERSE] > 0.0) {
        const uint4 more = random_words((uint4)(index, step, MOTION_STREAM + 1, 0), key_0, key_1);
        ahead = uniform_of(more.x) < settings[REVERSE] ? -ahead : ahead;
    }
    const long place = 3 * (long)n;
    const double x = source[place], y = source[place + 1], theta = source[place + 2] + first;
    const double2 heading = cos_sin(theta);
    target[place] = x + (ahead * heading.x - left * heading.y);
    target[place + 1] = y + (ahead * heading.y + left * heading.x);
    target[place + 2] = wrap_any(theta + second);
}
