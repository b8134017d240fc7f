// Counter-based random numbers: a particle's numbers depend only on seed, step, stream and its index; see the
// reference.
// requires: elementary heading

#define MULTIPLIER_0 0xD2511F53u
#define MULTIPLIER_1 0xCD9E8D57u
#define WEYL_0 0x9E3779B9u
#define WEYL_1 0xBB67AE85u
#define ROUNDS 10
// 2^-32, and that many turns in radians.
#define WORD 2.3283064365386963e-10
#define WORD_TURN 1.4629180792671596e-09

// Return four random words for a counter.
uint4 random_words(const uint4 counter, const uint key_0, const uint key_1) {
    uint4 c = counter;
    uint k0 = key_0, k1 = key_1;
#pragma unroll
    for (int i = 0; i < ROUNDS; i++) {
        const uint high_0 = mul_hi(c.x, MULTIPLIER_0), low_0 = c.x * MULTIPLIER_0;
        const uint high_1 = mul_hi(c.z, MULTIPLIER_1), low_1 = c.z * MULTIPLIER_1;
        c = (uint4)(high_1 ^ c.y ^ k0, low_1, high_0 ^ c.w ^ k1, low_0);
        k0 += WEYL_0, k1 += WEYL_1;
    }
    return c;
}

// Return a word as a number.
double number_of(const uint word) { return (double)word; }

// Return a number in (0, 1), the centre of one of 2^32 intervals.
double uniform_of(const uint word) { return (number_of(word) + 0.5) * WORD; }

// Return two independent standard normal deviates.
double2 normal_pair(const uint word_0, const uint word_1) {
    const double radius = sqrt(-2.0 * log_of(uniform_of(word_0)));
    const double2 turn = cos_sin(number_of(word_1) * WORD_TURN);
    return (double2)(radius * turn.x, radius * turn.y);
}
