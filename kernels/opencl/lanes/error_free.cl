// Error-free transformations in lanes: error_free.cl for LANES numbers at once, with the same bits.
// requires: lanes/types

// A sum of two numbers in each lane.
typedef struct {
    lanes hi, lo;
} LanePair;

// Return a + b = hi + lo exactly.
LanePair two_sum_lanes(const lanes a, const lanes b) {
    const lanes sum = a + b, shift = sum - a;
    return (LanePair){sum, (a - (sum - shift)) + (b - shift)};
}

// Return a + b = hi + lo exactly, where a's exponent is at least b's: Dekker's sum, in half of the operations.
LanePair ordered_sum_lanes(const lanes a, const lanes b) {
    const lanes sum = a + b;
    return (LanePair){sum, b - (sum - a)};
}

// Return a * b = hi + lo by a fused multiply-add.
LanePair fused_product_lanes(const lanes a, const lanes b) {
    const lanes product = a * b;
    return (LanePair){product, fma(a, b, -product)};
}

// Return a * b = hi + lo exactly, barring overflow and underflow: by a fused multiply-add where the processor has one.
LanePair two_product_lanes(const lanes a, const lanes b) {
    if (FUSES) return fused_product_lanes(a, b);
    const lanes product = a * b, scaled_a = SPLITTER * a, scaled_b = SPLITTER * b;
    const lanes a_high = scaled_a - (scaled_a - a), b_high = scaled_b - (scaled_b - b);
    const lanes a_low = a - a_high, b_low = b - b_high;
    return (LanePair){product, ((a_high * b_high - product) + a_high * b_low + a_low * b_high) + a_low * b_low};
}

// Return c - a b, where c is a b rounded or nearly so.
lanes rest_lanes(const lanes a, const lanes b, const lanes c) {
    if (FUSES) return fma(-a, b, c);
    const LanePair product = two_product_lanes(a, b);
    return (c - product.hi) - product.lo;
}

// Add two numbers of two parts each, to about twice the working precision. Where the first parts cancel, their sum is
// at least the last bit of either, so its exponent is at least that of the second parts.
LanePair pair_sum_lanes(const LanePair a, const LanePair b) {
    const LanePair sum = two_sum_lanes(a.hi, b.hi);
    return ordered_sum_lanes(sum.hi, sum.lo + (a.lo + b.lo));
}

// Multiply two numbers of two parts each, to about twice the working precision.
LanePair pair_product_lanes(const LanePair a, const LanePair b) {
    const LanePair product = two_product_lanes(a.hi, b.hi);
    return ordered_sum_lanes(product.hi, product.lo + (a.hi * b.lo + a.lo * b.hi));
}
