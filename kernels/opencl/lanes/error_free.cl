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

lanes to_real_lanes(const ilanes i) { return to_lanes(i); }

// in lanes: two_sum ordered_sum high_half two_product rest_of pair_sum pair_product add_term scaled_sum where_pair

// Return a b + c, rounded once where the device has a fused multiply-add.
lanes multiply_add_lanes(const lanes a, const lanes b, const lanes c) { return FUSES ? fma(a, b, c) : a * b + c; }
