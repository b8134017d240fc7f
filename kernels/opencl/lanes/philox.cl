// Random numbers of 8 particles: those of philox.cl. Words stand in the lower halves of integers of 64 bits.
// requires: philox lanes/elementary lanes/heading

// Compute four random words for each index.
void random_words_lanes(const ulong8 index, const uint step, const uint stream, const uint key_0, const uint key_1,
                        ulong8 *words) {
    const ulong8 lower = 0xFFFFFFFFUL;
    ulong8 c0 = index, c1 = step, c2 = stream, c3 = 0;
    uint k0 = key_0, k1 = key_1;
#pragma unroll
    for (int i = 0; i < ROUNDS; i++) {
        const ulong8 product_0 = c0 * (ulong)MULTIPLIER_0, product_1 = c2 * (ulong)MULTIPLIER_1;
        c0 = (product_1 >> 32) ^ c1 ^ (ulong)k0;
        c2 = (product_0 >> 32) ^ c3 ^ (ulong)k1;
        c1 = product_1 & lower, c3 = product_0 & lower;
        k0 += WEYL_0, k1 += WEYL_1;
    }
    words[0] = c0, words[1] = c1, words[2] = c2, words[3] = c3;
}

// Return words as numbers.
doubles number_lanes(const ulong8 word) { return as_double8(word | INTEGER_BITS) - INTEGERS; }

// Return numbers in (0, 1): the centres of intervals out of 2^32.
doubles uniform_of_lanes(const ulong8 word) { return (number_lanes(word) + 0.5) * WORD; }

// Compute two independent standard normal deviates for each pair of words.
void normal_pair_lanes(const ulong8 word_0, const ulong8 word_1, doubles *one, doubles *two) {
    const doubles radius = sqrt(-2.0 * log_of_lanes(uniform_of_lanes(word_0)));
    doubles cosine, sine;
    cos_sin_lanes(number_lanes(word_1) * WORD_TURN, &cosine, &sine);
    *one = radius * cosine, *two = radius * sine;
}
