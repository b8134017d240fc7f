// Error-free transformations: a second number holds the rounding error of an operation. Source: Knuth (two_sum),
// Dekker and Veltkamp (two_product). They need FP_CONTRACT OFF and no fast-math.

// An integer, or whether a comparison holds; in lanes, each lane has one.
typedef int integer;

// Convert an integer.
real to_real(const integer i) { return (real)i; }

// Return a + b = sum.x + sum.y exactly.
real2 two_sum(const real a, const real b) {
    const real sum = a + b;
    const real shift = sum - a;
    return (real2)(sum, (a - (sum - shift)) + (b - shift));
}

// Return a + b = sum.x + sum.y exactly, where a's exponent is at least b's: Dekker's sum.
real2 ordered_sum(const real a, const real b) {
    const real sum = a + b;
    return (real2)(sum, b - (sum - a));
}

// Return the leading bits of a float, so few that the product of two such halves is exact.
real high_half(const real a) {
    const real scaled = SPLITTER * a;
    return scaled - (scaled - a);
}

// Return a * b = product.x + product.y exactly, barring overflow and underflow: by a fused multiply-add where the
// device has one.
real2 two_product(const real a, const real b) {
    const real product = a * b;
    if (FUSES) return (real2)(product, fma(a, b, -product));
    const real a_high = high_half(a), b_high = high_half(b);
    const real a_low = a - a_high, b_low = b - b_high;
    const real error = ((a_high * b_high - product) + a_high * b_low + a_low * b_high) + a_low * b_low;
    return (real2)(product, error);
}

// Return c - a b, where c is a b rounded or nearly so.
real rest_of(const real a, const real b, const real c) {
    if (FUSES) return fma(-a, b, c);
    const real2 product = two_product(a, b);
    return (c - product.x) - product.y;
}

// Add two numbers of two parts each, to about twice the working precision. When the first parts cancel, their sum is at
// least the last bit of either, so its exponent is no smaller than the second parts' exponent.
real2 pair_sum(const real2 a, const real2 b) {
    const real2 sum = two_sum(a.x, b.x);
    return ordered_sum(sum.x, sum.y + (a.y + b.y));
}

// Multiply two numbers of two parts each, to about twice the working precision.
real2 pair_product(const real2 a, const real2 b) {
    const real2 product = two_product(a.x, b.x);
    return ordered_sum(product.x, product.y + (a.x * b.y + a.y * b.x));
}

// Adding and subtracting this number rounds to nearest.
#if FLOAT64
#define ROUNDING ((real)6755399441055744.0)
#else
#define ROUNDING ((real)12582912)
#endif

// Return the largest integer not above a; some drivers call floor as a function.
int floor_int(const real a) {
    const int whole = (int)a;
    return whole - ((real)whole > a);
}

// Sums over beams add the terms of a block plainly, then the sum of the block to a compensated total. The accuracy is
// nearly that of compensating every term, the cost nearly that of compensating none. A block of the beam model's sums has STRANDS strands; strand i has every fourth term from term i on. Each strand is
// added plainly, then its sum to the compensated total. So work-items or lanes that share a block exchange no terms.

// Add a term to a compensated sum: total.x is the running sum, total.y the sum of its rounding errors.
real2 add_term(const real2 total, const real term) {
    const real2 sum = two_sum(total.x, term);
    return (real2)(sum.x, total.y + sum.y);
}

// Return a compensated sum times a factor; an infinite sum has no second part.
real scaled_sum(const real2 total, const real factor) {
    const real sum = factor * (total.x + total.y);
    return total.x - total.x == 0 ? sum : total.x;
}

// Return one pair of numbers where a comparison holds, and the other one elsewhere.
real2 where_pair(const integer holds, const real2 one, const real2 other) {
    return (real2)(holds ? one.x : other.x, holds ? one.y : other.y);
}

// Add a block to a compensated sum, by its strands.
real2 add_strands(const real2 total, const real4 strands) {
    return add_term(add_term(add_term(add_term(total, strands.x), strands.y), strands.z), strands.w);
}
