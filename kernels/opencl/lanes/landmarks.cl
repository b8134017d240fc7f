// Density of one feature at one landmark for LANES particles at once: landmarks.cl in lanes. Every lane has the
// arithmetic of the scalar kernel, except that exp, log and erf come from lanes/math, that the arc tangent has two arcs
// only, 0 and pi/4, and that a fused multiply-add gives the rounding error of a product.
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
    const LanePair sum = two_sum_lanes((lanes)c, -a.hi);
    return two_sum_lanes(sum.hi, sum.lo + (c_low - a.lo));
}

LanePlace direction_lanes(const LanePlace heading, global const real *feature) {
    const float c = feature[COSINE], s = feature[SINE], c_low = feature[COSINE_LOW], s_low = feature[SINE_LOW];
    const LanePair cc = fused_product_lanes(heading.x.hi, (lanes)c), ss = fused_product_lanes(heading.y.hi, (lanes)s);
    const LanePair cs = fused_product_lanes(heading.x.hi, (lanes)s), sc = fused_product_lanes(heading.y.hi, (lanes)c);
    LanePlace turned = {two_sum_lanes(cc.hi, -ss.hi), two_sum_lanes(sc.hi, cs.hi)};
    turned.x.lo += (cc.lo - ss.lo) +
                   ((heading.x.hi * c_low + heading.x.lo * c) - (heading.y.hi * s_low + heading.y.lo * s));
    turned.y.lo += (sc.lo + cs.lo) +
                   ((heading.y.hi * c_low + heading.y.lo * c) + (heading.x.hi * s_low + heading.x.lo * s));
    return turned;
}

// Return the angle between an offset and a direction: its absolute value, in [0, pi]; with FIELD also its sign.
LanePair angle_pair_lanes(const LanePlace off, const LanePlace turned) {
    const LanePair right = fused_product_lanes(turned.x.hi, off.y.hi);
    const LanePair left = fused_product_lanes(turned.y.hi, off.x.hi);
    const LanePair forth = fused_product_lanes(turned.x.hi, off.x.hi);
    const LanePair more = fused_product_lanes(turned.y.hi, off.y.hi);
    LanePair side = two_sum_lanes(right.hi, -left.hi), ahead = two_sum_lanes(forth.hi, more.hi);
    side.lo += (right.lo - left.lo) + ((turned.x.hi * off.y.lo + turned.x.lo * off.y.hi) -
                                       (turned.y.hi * off.x.lo + turned.y.lo * off.x.hi));
    ahead.lo += (forth.lo + more.lo) + ((turned.x.hi * off.x.lo + turned.x.lo * off.x.hi) +
                                        (turned.y.hi * off.y.lo + turned.y.lo * off.y.hi));
    const ilanes behind = ahead.hi < 0, under = side.hi < 0;
    const LanePair a = {behind ? -ahead.hi : ahead.hi, behind ? -ahead.lo : ahead.lo};
    const LanePair b = {under ? -side.hi : side.hi, under ? -side.lo : side.lo};
    const ilanes steep = b.hi > a.hi;
    LanePair num = {steep ? a.hi : b.hi, steep ? a.lo : b.lo}, den = {steep ? b.hi : a.hi, steep ? b.lo : a.lo};
    const ilanes large = num.hi > EIGHTH_SLOPE * den.hi;
    if (any_lane(large)) {
        // (num - den) / (num + den) is the slope from 1 on.
        const LanePair less = two_sum_lanes(num.hi, -den.hi), sum = two_sum_lanes(den.hi, num.hi);
        num = (LanePair){large ? less.hi : num.hi, large ? less.lo + (num.lo - den.lo) : num.lo};
        den = (LanePair){large ? sum.hi : den.hi, large ? sum.lo + (den.lo + num.lo) : den.lo};
    }
    const lanes one_over = 1.0f / den.hi, t = num.hi * one_over;
    const lanes t_low = (fma(-t, den.hi, num.hi) + (num.lo - t * den.lo)) * one_over;
    const LanePair sum = two_sum_lanes(large ? (lanes)EIGHTH_TURN : (lanes)0, t);
    LanePair arc = two_sum_lanes(sum.hi,
                                 sum.lo + ((large ? (lanes)EIGHTH_TURN_LOW : (lanes)0) + (t_low + arc_rest_lanes(t))));
    if (any_lane(steep)) {
        const LanePair rest = difference_lanes(QUARTER_TURN, QUARTER_TURN_LOW, arc);
        arc = (LanePair){steep ? rest.hi : arc.hi, steep ? rest.lo : arc.lo};
    }
    if (any_lane(behind)) {
        const LanePair rest = difference_lanes(HALF_TURN, HALF_TURN_LOW, arc);
        arc = (LanePair){behind ? rest.hi : arc.hi, behind ? rest.lo : arc.lo};
    }
#if FIELD
    arc = (LanePair){under ? -arc.hi : arc.hi, under ? -arc.lo : arc.lo};
#endif
    return arc;
}

#if FIELD
lanes field_mass_lanes(const LanePair angle, global const real *feature, const float field) {
    const float scale = feature[BEARING_SCALE], whole = 2 * HALF_TURN;
    lanes left = (feature[UPPER] - angle.hi) + (feature[UPPER_LOW] - angle.lo);
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
    const LanePair u = fused_product_lanes(residual.hi, (lanes)scale);
    const lanes u_low = u.lo + (residual.hi * scale_low + residual.lo * scale);
    const LanePair square = fused_product_lanes(u.hi, u.hi), sum = two_sum_lanes(total.hi, square.hi);
    const lanes low = sum.lo + (total.lo + (square.lo + 2.0f * u.hi * u_low));
    // After an overflow there is no low part.
    return (LanePair){sum.hi, low - low == 0 ? low : (lanes)0};
}

// Return log(z_detect p(f | j)) of a feature at an offset; signature is the landmark's.
lanes log_detection_lanes(const LanePlace off, const LanePlace turned, global const real *feature,
                          const real4 signature, global const FeatureTerms *terms) {
    LanePair exponent = {0, 0};
    lanes mass = 1;
#if SIGNATURE
    float norm = 0;
#endif
    const LanePair d = distance_pair_lanes(off);
#if RANGE
    if (feature[RANGE_SCALE] > 0) {
        const float scale = feature[RANGE_SCALE];
        const LanePair r = two_sum_lanes(d.hi, (lanes)-feature[RANGE_AT]);
        exponent = add_square_lanes(exponent, two_sum_lanes(r.hi, r.lo + (d.lo - feature[RANGE_LOW])), scale,
                                    feature[RANGE_SCALE_LOW]);
        const lanes inside = d.hi < terms->range_max ? d.hi : (lanes)terms->range_max;
        const lanes left = (terms->range_max - d.hi) + (terms->range_max_low - d.lo);
        const lanes below = inside * scale, above = (left > 0 ? left : (lanes)0) * scale;
        if (any_lane((below < above ? below : above) < (float)ERF_ONE))
            mass = 0.5f * (erf_lanes(below) + erf_lanes(above));
    }
#endif
#if BEARING
    if (feature[BEARING_SCALE] > 0) {
        const ilanes has_bearing = d.hi > (float)ZERO_RANGE;
        const LanePair angle = angle_pair_lanes(off, turned);
        const LanePair more =
            add_square_lanes(exponent, angle, feature[BEARING_SCALE], feature[BEARING_SCALE_LOW]);
        exponent = (LanePair){has_bearing ? more.hi : exponent.hi, has_bearing ? more.lo : exponent.lo};
#if FIELD
        const lanes seen = field_mass_lanes(angle, feature, terms->field_of_view);
#else
        const lanes seen = 1;
#endif
        mass = mass * (has_bearing ? seen : (lanes)(terms->zero_range_density * feature[BEARING_SCALE]));
    }
#endif
#if SIGNATURE
    if (feature[SIGNATURE_SCALE] > 0) {
        // The error of the signature is the same for all particles.
        const real2 first = two_sum(feature[SIGNATURE_AT], -signature.x);
        const real2 s = two_sum(first.x, first.y + (feature[SIGNATURE_LOW] - signature.y));
        const real2 alone = add_square(0, s, feature[SIGNATURE_SCALE], feature[SIGNATURE_SCALE_LOW]);
        const LanePair more = two_sum_lanes(exponent.hi, (lanes)alone.x);
        const lanes low = more.lo + (exponent.lo + alone.y);
        exponent = (LanePair){more.hi, low - low == 0 ? low : (lanes)0};
        norm = signature.z;
    }
#endif
#if SIGNATURE
    const lanes log_p = (feature[PEAK] - exponent.hi) + ((feature[PEAK_LOW] - exponent.lo) + norm);
#else
    const lanes log_p = (feature[PEAK] - exponent.hi) + (feature[PEAK_LOW] - exponent.lo);
#endif
    return any_lane(mass != 1) ? (mass == 1 ? log_p : log_p - log_lanes(mass)) : log_p;
}
