// Offsets between places, exponents and logarithms of densities: log_terms.cl in lanes, with the functions of lanes/math.
// A fused multiply-add gives the rounding error of a product.
// requires: log_terms lanes/error_free lanes/math

// A place, an offset or a direction in each lane.
typedef struct {
    LanePair x, y;
} LanePlace;

LanePlace offset_lanes(const real4 landmark, const LanePlace place) {
    const LanePair x = two_sum_lanes((lanes)landmark.x, -place.x.hi), y = two_sum_lanes((lanes)landmark.y, -place.y.hi);
    return (LanePlace){two_sum_lanes(x.hi, x.lo + (landmark.z - place.x.lo)),
                       two_sum_lanes(y.hi, y.lo + (landmark.w - place.y.lo))};
}

LanePair distance_pair_lanes(const LanePlace off) {
    const LanePair xx = fused_product_lanes(off.x.hi, off.x.hi), yy = fused_product_lanes(off.y.hi, off.y.hi);
    const LanePair sum = two_sum_lanes(xx.hi, yy.hi);
    const lanes d = sqrt(sum.hi);
    const LanePair dd = fused_product_lanes(d, d);
    const lanes rest = (sum.hi - dd.hi) + ((sum.lo + ((xx.lo + yy.lo) - dd.lo)) +
                                           2.0f * (off.x.hi * off.x.lo + off.y.hi * off.y.lo));
    return (LanePair){d, d > 0 ? rest / (2.0f * d) : (lanes)0};
}

// Read LANES numbers of two parts; the last of count is repeated beyond the end.
LanePair load_pairs(global const real *numbers, const int count) {
    if (count >= LANES) {
        const lanes a = load_lanes(0, numbers), b = load_lanes(1, numbers);
        return (LanePair){(lanes)(a.even, b.even), (lanes)(a.odd, b.odd)};
    }
    LanePair some;
    for (int i = 0; i < LANES; ++i) {
        const int at = 2 * min(i, count - 1);
        ((real *)&some.hi)[i] = numbers[at], ((real *)&some.lo)[i] = numbers[at + 1];
    }
    return some;
}

// Read LANES places from index first on; a lane beyond the last of count repeats it.
LanePlace load_places(global const real4 *place, const int first, const int count) {
    LanePlace some;
    if (first + LANES <= count) {
        global const real *numbers = (global const real *)(place + first);
        const lanes a = load_lanes(0, numbers), b = load_lanes(1, numbers);
        const lanes c = load_lanes(2, numbers), d = load_lanes(3, numbers);
        some.x.hi = (lanes)(a.s048c, b.s048c, c.s048c, d.s048c);
        some.x.lo = (lanes)(a.s159d, b.s159d, c.s159d, d.s159d);
        some.y.hi = (lanes)(a.s26ae, b.s26ae, c.s26ae, d.s26ae);
        some.y.lo = (lanes)(a.s37bf, b.s37bf, c.s37bf, d.s37bf);
        return some;
    }
    for (int i = 0; i < LANES; ++i) {
        const real4 one = place[min(first + i, count - 1)];
        ((real *)&some.x.hi)[i] = one.x, ((real *)&some.x.lo)[i] = one.y;
        ((real *)&some.y.hi)[i] = one.z, ((real *)&some.y.lo)[i] = one.w;
    }
    return some;
}

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

lanes either_lanes(const lanes a, const lanes b) {
    const ilanes larger = a > b;
    const lanes high = larger ? a : b, low = larger ? b : a;
    const lanes sum_log = high + log_one_plus_lanes(exp_lanes(low - high));
    return high > -INFINITY ? sum_log : high;
}
