// Density of a line of a scan, in normal form, given a line of the map; ends do not count.
//     p(f | j) = N((alpha, rho); (alpha_j, rho_j), C) / m
// A line is the points with x cos alpha + y sin alpha = rho: alpha is the direction of its normal, away from the
// sensor, and rho its distance (Siegwart, Nourbakhsh and Scaramuzza, Introduction to Autonomous Mobile Robots, 2011,
// section 4.7). alpha_j and rho_j describe the map's line at the particle; alpha - alpha_j is wrapped to (-pi, pi].
// (alpha, rho) and (alpha + pi, -rho) are one line: where a line of the map is seen from both sides, the normal nearer
// to the feature's counts. m is the mass of the distance on [0, range_max]. By Cholesky's factor of C the exponent is
// (a da)^2 + (b da + c dr)^2 with a = BEARING_SCALE, b = MIXED_SCALE and c = RANGE_SCALE. A feature may be a line of
// the map if its projection overlaps that line: a scan shows only the visible part of a wall. A line of the map has its
// middle as landmark, its normal away from the free side, and (half length, 1 if it is seen from both sides, 0, 0) as
// signature.
// requires: error_free landmarks offsets

// The factor of the angle in the second exponent; places of the ends along the line, from the foot of the normal.
#define MIXED_SCALE 12
#define MIXED_SCALE_LOW 13
#define FIRST_END 17
#define LAST_END 18

#if LINE
// Return the normal of a line of the map on the side that faces a feature's sensor.
real4 facing(const real4 normal, const real4 signature, const real4 turned) {
    return signature.y > 0 && normal.x * turned.x + normal.z * turned.z < 0 ? -normal : normal;
}

// Return whether a feature has about the direction of a line of the map, and overlaps it.
int overlaps(const real4 off, const real4 turned, global const real *feature, const real4 normal,
             const real4 signature) {
    const real cosine = normal.x * turned.x + normal.z * turned.z;
    const real sine = normal.x * turned.z - normal.z * turned.x;
    const real foot = feature[RANGE_AT] * sine - (normal.x * off.z - normal.z * off.x);
    const real one = foot + feature[FIRST_END] * cosine, other = foot + feature[LAST_END] * cosine;
    return cosine >= feature[AXIS] && fmin(one, other) <= signature.x && fmax(one, other) >= -signature.x;
}

// Return the mass of the normal around a line's distance d on [0, range_max]; d is clamped to it. A line that is seen
// from both sides has two forms, (alpha_j, d) and (alpha_j + pi, -d): together they have the mass of d on [-range_max,
// range_max].
real distance_mass(const real2 d, const real scale, const real4 signature, global const FeatureTerms *terms) {
    const real lower = signature.y > 0 ? -terms->range_max : (real)0, width = terms->range_max - lower;
    const real below = clamp((d.x - lower) + d.y, (real)0, width) * scale;
    const real above = clamp((terms->range_max - d.x) + (terms->range_max_low - d.y), (real)0, width) * scale;
    if (below > ERF_ONE && above > ERF_ONE) return 1;
    return (real)0.5 * (erf(below) + erf(above));
}

// Return log(z_detect p(f | j)) of one feature at the offset of a line's middle.
real log_line(const real4 off, const real4 turned, global const real *feature, const real4 normal,
              const real4 signature, global const FeatureTerms *terms, global const real2 *arcs) {
    const real2 da = angle_pair(across(turned, normal), along(turned, normal), arcs);
    const real2 d = along(off, normal);
    const real2 first = two_sum(feature[RANGE_AT], -d.x);
    const real2 dr = two_sum(first.x, first.y + (feature[RANGE_LOW] - d.y));
    const real2 mixed = pair_product(da, (real2)(feature[MIXED_SCALE], feature[MIXED_SCALE_LOW]));
    const real2 plain = pair_product(dr, (real2)(feature[RANGE_SCALE], feature[RANGE_SCALE_LOW]));
    real2 exponent = add_square(0, da, feature[BEARING_SCALE], feature[BEARING_SCALE_LOW]);
    exponent = add_square(exponent, pair_sum(mixed, plain), 1, 0);
    const real mass = distance_mass(d, feature[RANGE_SPREAD], signature, terms);
    const real log_p = (feature[PEAK] - exponent.x) + (feature[PEAK_LOW] - exponent.y);
    return mass == 1 ? log_p : log_p - log(mass);
}
#endif
