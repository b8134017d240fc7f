// Random numbers of 8 particles: those of philox.cl. Words fill the lower halves of 64-bit integers, so that products
// are exact.
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
doubles number_of_lanes(const ulong8 word) { return as_double8(word | INTEGER_BITS) - INTEGERS; }

// in lanes: uniform_of normal_pair
