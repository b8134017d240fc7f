// Exponents and logarithms of densities: log_terms.cl in lanes, with the functions of lanes/math.
// requires: log_terms lanes/error_free lanes/math

// Return the square of a sum of two numbers; roots are clamped, so that nothing becomes infinite.
LanePair bounded_square_lanes(const LanePair u) {
    const ilanes large = (u.hi > LARGEST_ROOT) | (u.hi < -LARGEST_ROOT);
    const lanes high = large ? (lanes)LARGEST_ROOT : u.hi, low = large ? (lanes)0 : u.lo;
    const LanePair square = fused_product_lanes(high, high);
    return two_sum_lanes(square.hi, square.lo + (high * low + low * high));
}

// Return the product of sums of two numbers; one factor is the same in all lanes.
LanePair scaled_pair_lanes(const LanePair a, const float scale, const float scale_low) {
    const LanePair product = fused_product_lanes(a.hi, (lanes)scale);
    return two_sum_lanes(product.hi, product.lo + (a.hi * scale_low + a.lo * scale));
}

// in lanes: log_one_plus

// Return the log of the sum of two probabilities, from their logs; -inf only where both are 0.
lanes either_lanes(const lanes a, const lanes b) {
    const ilanes larger = a > b;
    const lanes high = larger ? a : b, low = larger ? b : a;
    const lanes sum_log = high + log_one_plus_lanes(exp_lanes(low - high));
    return high > -INFINITY ? sum_log : high;
}
