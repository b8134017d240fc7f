// Density of one feature (range, bearing, signature) at one landmark, book table 6.4, with normalised components; see
// the reference.
// requires: error_free log_terms

// Arcs of i / 8, of a quarter and of half a turn, as sums of two numbers, are arcs[0] to arcs[10].
// Below this distance [m] all bearings are equally likely.
#define ZERO_RANGE ((real)1e-6)
// From here on the error function is 1 to the last bit.
#define ERF_ONE ((real)(FLOAT64 ? 6 : 4))

// Return the place of a sensor in metres from the origin of the buckets; size, a power of two, is the side of a bucket.
real4 sensor_place(const int2 cell, const real4 pose, const real4 low, const real size) {
    const real2 x = two_sum((real)cell.x, pose.x), y = two_sum((real)cell.y, pose.y);
    return size * (real4)(x.x, x.y + low.x, y.x, y.y + low.y);
}

// Return the direction of a feature in the world: the heading, turned by the bearing.
real4 direction(const real4 pose, const real4 pose_low, global const real *feature) {
    const real c = feature[COSINE], s = feature[SINE], c_low = feature[COSINE_LOW], s_low = feature[SINE_LOW];
    const real2 cc = two_product(pose.z, c), ss = two_product(pose.w, s);
    const real2 cs = two_product(pose.z, s), sc = two_product(pose.w, c);
    const real2 x = two_sum(cc.x, -ss.x), y = two_sum(sc.x, cs.x);
    const real x_low = (pose.z * c_low + pose_low.z * c) - (pose.w * s_low + pose_low.w * s);
    const real y_low = (pose.w * c_low + pose_low.w * c) + (pose.z * s_low + pose_low.z * s);
    return (real4)(x.x, x.y + ((cc.y - ss.y) + x_low), y.x, y.y + ((sc.y + cs.y) + y_low));
}

#if BEARING
// Return the component of an offset to the left of a direction.
real2 across(const real4 off, const real4 turned) {
    const real2 right = two_product(turned.x, off.z), left = two_product(turned.z, off.x);
    const real2 sum = two_sum(right.x, -left.x);
    const real low = (turned.x * off.w + turned.y * off.z) - (turned.z * off.y + turned.w * off.x);
    return (real2)(sum.x, sum.y + ((right.y - left.y) + low));
}

// Return the component of an offset along a direction.
real2 along(const real4 off, const real4 turned) {
    const real2 x = two_product(turned.x, off.x), y = two_product(turned.z, off.z);
    const real2 sum = two_sum(x.x, y.x);
    const real low = (turned.x * off.y + turned.y * off.x) + (turned.z * off.w + turned.w * off.z);
    return (real2)(sum.x, sum.y + ((x.y + y.y) + low));
}

// Return arctan t / t - 1 for |t| <= 1 / 16, by its power series in t^2.
real arc_series(const real t) {
    const real z = t * t;
    const real high = (real)1 / 9 + z * ((real)-1 / 11 + z * ((real)1 / 13 + z * ((real)-1 / 15)));
    return z * ((real)-1 / 3 + z * ((real)1 / 5 + z * ((real)-1 / 7 + z * high)));
}

// Return the angle of an offset in (-pi, pi]: the arc of the nearest slope i / 8, and a series for the rest.
real2 angle_pair(const real2 side, const real2 ahead, global const real2 *arcs) {
    const real2 a = signbit(ahead.x) ? -ahead : ahead, b = signbit(side.x) ? -side : side;
    const int steep = b.x > a.x;
    const real2 num = steep ? a : b, den = steep ? b : a;
    const real safe = den.x > 0 ? den.x : (real)1;
    const real step = floor(num.x / safe * ARC_STEPS + (real)0.5), slope = step / ARC_STEPS;
    const real2 less = two_product(slope, den.x), more = two_product(slope, num.x);
    const real2 first = two_sum(num.x, -less.x), bottom = two_sum(safe, more.x);
    const real2 top = two_sum(first.x, first.y + ((num.y - slope * den.y) - less.y));
    const real bottom_low = bottom.y + ((den.y + slope * num.y) + more.y);
    const real t = top.x / bottom.x;
    const real2 back = two_product(t, bottom.x);
    const real t_low = (((top.x - back.x) - back.y) + (top.y - t * bottom_low)) / bottom.x;
    const real2 base = arcs[(int)step];
    const real2 sum = two_sum(base.x, t);
    real2 arc = two_sum(sum.x, sum.y + (base.y + (t_low + t * arc_series(t))));
    if (steep) arc = pair_sum(arcs[ARC_STEPS + 1], -arc);
    if (signbit(ahead.x)) arc = pair_sum(arcs[ARC_STEPS + 2], -arc);
    return signbit(side.x) ? -arc : arc;
}
#endif

#if RANGE
// Return the mass of the normal around d on [0, range_max]; d is clamped to range_max.
real range_mass(const real2 d, const real scale, global const FeatureTerms *terms) {
    const real most = terms->range_max, left = (most - d.x) + (terms->range_max_low - d.y);
    const real below = (d.x < most ? d.x : most) * scale, above = (left > 0 ? left : (real)0) * scale;
    if (!in_any((below < ERF_ONE) | (above < ERF_ONE))) return 1;
    return (real)0.5 * (erf(below) + erf(above));
}
#endif

#if FIELD
// Return the mass of the normal around a landmark's bearing on the field of view; the bearing is clamped to its ends.
// Parts of the field more than half a turn away from the landmark are nearer in the other direction.
real field_mass(const real2 angle, global const real *feature, global const FeatureTerms *terms,
                global const real2 *arcs) {
    const real scale = feature[BEARING_SCALE];
    const real half_turn = arcs[ARC_STEPS + 2].x, whole = 2 * half_turn, field = terms->field_of_view;
    real left = (feature[UPPER] - angle.x) + (feature[UPPER_LOW] - angle.y);
    if (field / 2 - left > half_turn)
        left += whole;
    else if (field / 2 - left < -half_turn)
        left -= whole;
    left = clamp(left, (real)0, field);
    const real right = field - left;
    real mass = erf(fmin(left, half_turn) * scale) + erf(fmin(right, half_turn) * scale);
    if (left > half_turn) mass += erf(half_turn * scale) - erf((whole - left) * scale);
    if (right > half_turn) mass += erf(half_turn * scale) - erf((whole - right) * scale);
    return (real)0.5 * mass;
}
#endif

// Add (residual * scale)^2 to an exponent, in two parts, since exponents and peaks may nearly cancel.
real2 add_square(const real2 total, const real2 residual, const real scale, const real scale_low) {
    const real2 u = pair_product(residual, (real2)(scale, scale_low));
    const real2 more = pair_sum(total, pair_product(u, u));
    // After an overflow there is no low part.
    return (real2)(more.x, isfinite(more.y) ? more.y : (real)0);
}

#if SIGNATURE
// Add the square of the signature's error to an exponent; signature is (s_j, low part, -log m_s, 0).
real2 add_signature(const real2 exponent, global const real *feature, global const real4 *signature) {
    const real2 first = two_sum(feature[SIGNATURE_AT], -signature->x);
    const real2 s = two_sum(first.x, first.y + (feature[SIGNATURE_LOW] - signature->y));
    return add_square(exponent, s, feature[SIGNATURE_SCALE], feature[SIGNATURE_SCALE_LOW]);
}
#endif

// Return log(z_detect p(f | j)) of one feature at an offset from a landmark with a signature.
real log_detection(const real4 off, const real4 turned, global const real *feature, global const real4 *signature,
                   global const FeatureTerms *terms, global const real2 *arcs) {
    real2 exponent = (real2)(0, 0);
    real mass = 1, norm = 0;
    const real2 d = distance_pair(off);
#if RANGE
    if (feature[RANGE_SCALE] > 0) {
        const real2 first = two_sum(d.x, -feature[RANGE_AT]);
        const real2 r = two_sum(first.x, first.y + (d.y - feature[RANGE_LOW]));
        exponent = add_square(exponent, r, feature[RANGE_SCALE], feature[RANGE_SCALE_LOW]);
        mass = range_mass(d, feature[RANGE_SCALE], terms);
    }
#endif
#if BEARING
    if (feature[BEARING_SCALE] > 0) {
        const integer has_bearing = d.x > ZERO_RANGE;
        const real2 angle = angle_pair(across(off, turned), along(off, turned), arcs);
        const real2 more = add_square(exponent, angle, feature[BEARING_SCALE], feature[BEARING_SCALE_LOW]);
        exponent = where_pair(has_bearing, more, exponent);
#if FIELD
        const real seen = field_mass(angle, feature, terms, arcs);
#else
        const real seen = 1;
#endif
        // The density of a missing bearing is 1 / field: the peak times zero_range_density and the scale.
        const real anywhere = terms->zero_range_density * feature[BEARING_SCALE];
        mass = mass * (has_bearing ? seen : anywhere);
    }
#endif
#if SIGNATURE
    if (feature[SIGNATURE_SCALE] > 0) {
        exponent = add_signature(exponent, feature, signature);
        norm = signature->z;
    }
#endif
    const real log_p = (feature[PEAK] - exponent.x) + ((feature[PEAK_LOW] - exponent.y) + norm);
    return in_any(mass != 1) ? log_p - log(mass) : log_p;
}
