// Density of one feature at one landmark for LANES particles at once: landmarks.cl in lanes. Every lane has the
// arithmetic of the scalar kernel, except that exp, log and erf come from lanes/math, and that the arc tangent has two
// arcs only, 0 and pi/4.
// requires: landmarks lanes/log_terms

// tan(pi/8); pi/4, pi/2 and pi as sums of two numbers.
#define EIGHTH_SLOPE 0.414213562f
#define EIGHTH_TURN 0.785398185f
#define EIGHTH_TURN_LOW -2.18556941e-08f
#define QUARTER_TURN 1.57079637f
#define QUARTER_TURN_LOW -4.37113883e-08f
#define HALF_TURN 3.14159274f
#define HALF_TURN_LOW -8.74227766e-08f

// Return c - a for a positive c.
LanePair difference_lanes(const float c, const float c_low, const LanePair a) {
    const LanePair sum = two_sum_lanes((lanes)c, -a.x);
    return two_sum_lanes(sum.x, sum.y + (c_low - a.y));
}

// in lanes: direction

#if BEARING
// in lanes: across along

// Return the angle of an offset: its absolute value, in [0, pi]; with FIELD also its sign.
LanePair angle_pair_lanes(const LanePair side, const LanePair ahead, global const real2 *arcs) {
    const ilanes behind = ahead.x < 0, under = side.x < 0;
    const LanePair a = {behind ? -ahead.x : ahead.x, behind ? -ahead.y : ahead.y};
    const LanePair b = {under ? -side.x : side.x, under ? -side.y : side.y};
    const ilanes steep = b.x > a.x;
    LanePair num = {steep ? a.x : b.x, steep ? a.y : b.y}, den = {steep ? b.x : a.x, steep ? b.y : a.y};
    const ilanes large = num.x > EIGHTH_SLOPE * den.x;
    if (any_lane(large)) {
        // (num - den) / (num + den) is the slope from 1 on.
        const LanePair less = two_sum_lanes(num.x, -den.x), sum = two_sum_lanes(den.x, num.x);
        num = (LanePair){large ? less.x : num.x, large ? less.y + (num.y - den.y) : num.y};
        den = (LanePair){large ? sum.x : den.x, large ? sum.y + (den.y + num.y) : den.y};
    }
    const lanes one_over = 1.0f / den.x, t = num.x * one_over;
    const lanes t_low = (fma(-t, den.x, num.x) + (num.y - t * den.y)) * one_over;
    const LanePair sum = two_sum_lanes(large ? (lanes)EIGHTH_TURN : (lanes)0, t);
    LanePair arc = two_sum_lanes(sum.x,
                                 sum.y + ((large ? (lanes)EIGHTH_TURN_LOW : (lanes)0) + (t_low + arc_rest_lanes(t))));
    if (any_lane(steep)) {
        const LanePair rest = difference_lanes(QUARTER_TURN, QUARTER_TURN_LOW, arc);
        arc = (LanePair){steep ? rest.x : arc.x, steep ? rest.y : arc.y};
    }
    if (any_lane(behind)) {
        const LanePair rest = difference_lanes(HALF_TURN, HALF_TURN_LOW, arc);
        arc = (LanePair){behind ? rest.x : arc.x, behind ? rest.y : arc.y};
    }
#if FIELD
    arc = (LanePair){under ? -arc.x : arc.x, under ? -arc.y : arc.y};
#endif
    return arc;
}
#endif

#if RANGE
// in lanes: range_mass
#endif

#if FIELD
lanes field_mass_lanes(const LanePair angle, global const real *feature, global const FeatureTerms *terms,
                       global const real2 *arcs) {
    const float scale = feature[BEARING_SCALE], whole = 2 * HALF_TURN, field = terms->field_of_view;
    lanes left = (feature[UPPER] - angle.x) + (feature[UPPER_LOW] - angle.y);
    const lanes off = field / 2 - left;
    left = off > HALF_TURN ? left + whole : off < -HALF_TURN ? left - whole : left;
    left = left > 0 ? left : (lanes)0;
    left = left < field ? left : (lanes)field;
    const lanes right = field - left;
    const lanes near_left = left < HALF_TURN ? left : (lanes)HALF_TURN;
    const lanes near_right = right < HALF_TURN ? right : (lanes)HALF_TURN;
    lanes mass = erf_lanes(near_left * scale) + erf_lanes(near_right * scale);
    if (field > HALF_TURN) {
        // Parts of the field more than half a turn away from the landmark are nearer in the other direction.
        const float half_mass = erf(HALF_TURN * scale);
        if (any_lane(left > HALF_TURN))
            mass += left > HALF_TURN ? half_mass - erf_lanes((whole - left) * scale) : (lanes)0;
        if (any_lane(right > HALF_TURN))
            mass += right > HALF_TURN ? half_mass - erf_lanes((whole - right) * scale) : (lanes)0;
    }
    return 0.5f * mass;
}
#endif

LanePair add_square_lanes(const LanePair total, const LanePair residual, const float scale, const float scale_low) {
    const LanePair u = two_product_lanes(residual.x, (lanes)scale);
    const lanes u_low = u.y + (residual.x * scale_low + residual.y * scale);
    const LanePair square = two_product_lanes(u.x, u.x), sum = two_sum_lanes(total.x, square.x);
    const lanes low = sum.y + (total.y + (square.y + 2.0f * u.x * u_low));
    // After an overflow there is no low part.
    return (LanePair){sum.x, low - low == 0 ? low : (lanes)0};
}

#if SIGNATURE
// The error of the signature is the same for all particles.
LanePair add_signature_lanes(const LanePair exponent, global const real *feature, global const real4 *signature) {
    const real2 alone = add_signature(0, feature, signature);
    const LanePair more = two_sum_lanes(exponent.x, (lanes)alone.x);
    const lanes low = more.y + (exponent.y + alone.y);
    return (LanePair){more.x, low - low == 0 ? low : (lanes)0};
}
#endif

// in lanes: log_detection
