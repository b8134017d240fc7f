// Search for the landmarks near the end point of a feature, book table 6.5; see the reference.
// requires: error_free landmarks log_terms

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

// A sum of densities is relative to one of them, until another is larger by a factor of e^RELATIVE.
#define RELATIVE 4

// Result of a search: the log density, of the likeliest landmark or with MARGINAL of all of them; the log density of
// the likeliest one, and its index.
typedef struct {
    real log_p, best;
    int chosen;
} Match;

// Return the row or column of the bucket at a position; positions outside get the nearest bucket.
int bucket_at(const real position, const real size, const int count) {
    return (int)clamp(floor(position / size), (real)0, (real)(count - 1));
}

// Return whether a landmark is in a feature's disc, within the limits of the sensor that the feature does not measure,
// and no farther from the end point than the square root of most.
int near(const real4 off, const real4 turned, global const real *feature, const real most) {
    const real reach = feature[REACH], radius = feature[RADIUS], hole = feature[HOLE];
    const real x = off.x - reach * turned.x, y = off.z - reach * turned.z, squared = off.x * off.x + off.z * off.z;
    const real apart = x * x + y * y;
    if (apart > radius * radius || squared < hole * hole) return 0;
    // The bound most holds for a disc around the end point itself.
    if (reach > 0 && reach == feature[RANGE_AT] && apart > most) return 0;
    const real d = sqrt(squared);
    return d <= feature[FARTHEST] && turned.x * off.x + turned.z * off.z >= feature[AXIS] * d;
}

// Return the square of the radius around a feature's end point outside which exponents are larger than exponent. Let r
// be the error of the range and b the error of the bearing: a landmark is sqrt(r^2 + 2 z (z + r) (1 - cos b)) away, and
// 2 (1 - cos b) <= b^2. A factor and SLACK cover rounding errors of such distances.
real squared_reach(const real exponent, global const real *feature) {
    const real none = 0, root = sqrt(exponent > none ? exponent : none), z = feature[RANGE_AT];
    const real r = root * feature[RANGE_SPREAD], b = root * feature[BEARING_SPREAD];
    return (real)1.01 * (r * r + z * (z + r) * (b * b)) + feature[SLACK];
}

// Return whether a feature may be landmark j: near its end point, or for lines similar in direction and overlapping.
int may_match(const real4 off, const real4 turned, global const real *feature, global const real4 *normal,
              global const real4 *signature, const int j, const real most) {
#if LINE
    return overlaps(off, turned, feature, facing(normal[j], signature[j], turned), signature[j]);
#else
    return near(off, turned, feature, most);
#endif
}

// Return log(z_detect p(f | j)) of one feature at the offset of landmark j.
real log_match(const real4 off, const real4 turned, global const real *feature, global const real4 *normal,
               global const real4 *signature, const int j, global const FeatureTerms *terms, global const real2 *arcs) {
#if LINE
    return log_line(off, turned, feature, facing(normal[j], signature[j], turned), signature[j], terms, arcs);
#else
    return log_detection(off, turned, feature, signature + j, terms, arcs);
#endif
}

// Update a match by one more landmark; sum is the sum of densities relative to match.log_p.
Match with_landmark(Match match, real2 *sum, const real log_p, const int j) {
#if MARGINAL
    if (isinf(match.log_p)) {
        match.log_p = log_p;
        *sum = (real2)(isinf(log_p) ? 0 : 1, 0);
    } else if (log_p > match.log_p + RELATIVE) {
        *sum = *sum * exp(match.log_p - log_p) + (real2)(1, 0);
        match.log_p = log_p;
    } else {
        *sum = add_term(*sum, exp(log_p - match.log_p));
    }
#endif
    if (log_p > match.best) {
        match.best = log_p;
        match.chosen = j;
    }
    return match;
}

// Return the match of a feature among the landmarks within its disc.
Match search(global const real4 *landmark, global const real4 *normal, global const real4 *signature,
             global const int *start, const real4 place, const real4 turned, global const real *feature,
             global const FeatureTerms *terms, global const real2 *arcs, const Buckets buckets) {
    Match match = {-INFINITY, -INFINITY, -1};
    real2 sum = 0;
    const real reach = feature[REACH], radius = feature[RADIUS];
    if (radius < 0) return match;
    // Landmarks that cannot be likelier than the best so far are not evaluated.
    real most = INFINITY;
    const real x = place.x + reach * turned.x, y = place.z + reach * turned.z;
    const int left = bucket_at(x - radius, buckets.size, buckets.cols);
    const int right = bucket_at(x + radius, buckets.size, buckets.cols);
    const int high = bucket_at(y + radius, buckets.size, buckets.rows);
    for (int row = bucket_at(y - radius, buckets.size, buckets.rows); row <= high; ++row) {
        const int last = start[row * buckets.cols + right + 1];
        for (int j = start[row * buckets.cols + left]; j < last; ++j) {
            const real4 off = offset(landmark[j], place);
            if (!may_match(off, turned, feature, normal, signature, j, most)) continue;
            const real log_p = log_match(off, turned, feature, normal, signature, j, terms, arcs);
            match = with_landmark(match, &sum, log_p, j);
#if !MARGINAL
#if !LINE
            most = squared_reach(feature[MOST] - match.best, feature);
#endif
#endif
        }
    }
#if MARGINAL
    if (!isinf(match.log_p)) match.log_p += log(sum.x + sum.y);
#else
    match.log_p = match.best;
#endif
    return match;
}
