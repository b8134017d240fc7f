// Error-free transformations in lanes: error_free.cl for LANES numbers at once, with the same bits.
// requires: lanes/types

// A sum of two numbers in each lane.
typedef struct {
    lanes x, y;
} LanePair;

// A place, an offset, a direction or a line in each lane.
typedef struct {
    lanes x, y, z, w;
} LaneQuad;

// in lanes: two_sum ordered_sum high_half two_product pair_sum pair_product add_term

// Return c - a b, where c is a b rounded or nearly so.
lanes rest_lanes(const lanes a, const lanes b, const lanes c) {
    if (FUSES) return fma(-a, b, c);
    const LanePair product = two_product_lanes(a, b);
    return (c - product.x) - product.y;
}

// Return a b + c, rounded once where the device has a fused multiply-add.
lanes multiply_add_lanes(const lanes a, const lanes b, const lanes c) { return FUSES ? fma(a, b, c) : a * b + c; }
