// Likelihood of features by the landmarks near to where each of them points, book table 6.5.
// Landmarks lie in square buckets, row by row; start has the first of each bucket. A feature looks into the buckets that a
// disc around its end point touches, and evaluates the landmarks within the disc; what is farther cannot matter.
// requires: error_free landmarks

// A sum of densities is kept relative to one of them until another is e to this larger.
#define RELATIVE 4

// What a search finds: log density of the likeliest landmark, or with MARGINAL of all, that one's, and its place.
typedef struct {
    real found, best;
    int chosen;
} Match;

// Row or column of the bucket at a position; the nearest one outside.
int bucket_at(const real position, const real size, const int count) {
    return (int)clamp(floor(position / size), (real)0, (real)(count - 1));
}

// Whether a landmark lies in a feature's disc, and within the limits of the sensor that it does not measure.
int near(const real4 off, const real4 turned, global const real *feature) {
    const real reach = feature[REACH], radius = feature[RADIUS], hole = feature[HOLE];
    const real x = off.x - reach * turned.x, y = off.z - reach * turned.z, squared = off.x * off.x + off.z * off.z;
    if (x * x + y * y > radius * radius || squared < hole * hole) return 0;
    const real d = sqrt(squared);
    return d <= feature[FARTHEST] && turned.x * off.x + turned.z * off.z >= feature[AXIS] * d;
}

// A match and one more landmark; sum is that of densities relative to found.
Match with_landmark(Match match, real2 *sum, const real log_p, const int j) {
#if MARGINAL
    if (isinf(match.found)) {
        match.found = log_p;
        *sum = (real2)(isinf(log_p) ? 0 : 1, 0);
    } else if (log_p > match.found + RELATIVE) {
        *sum = *sum * exp(match.found - log_p) + (real2)(1, 0);
        match.found = log_p;
    } else {
        *sum = add_term(*sum, exp(log_p - match.found));
    }
#endif
    if (log_p > match.best) {
        match.best = log_p;
        match.chosen = j;
    }
    return match;
}

Match search(global const real4 *landmark, global const real4 *signature, global const int *start, const real4 place,
             const real4 turned, global const real *feature, global const real *terms, global const real2 *arcs,
             const int rows, const int cols, const real size) {
    Match match = {-INFINITY, -INFINITY, -1};
    real2 sum = 0;
    const real reach = feature[REACH], radius = feature[RADIUS];
    if (radius < 0) return match;
    const real x = place.x + reach * turned.x, y = place.z + reach * turned.z;
    const int left = bucket_at(x - radius, size, cols), right = bucket_at(x + radius, size, cols);
    const int high = bucket_at(y + radius, size, rows);
    for (int row = bucket_at(y - radius, size, rows); row <= high; ++row) {
        const int last = start[row * cols + right + 1];
        for (int j = start[row * cols + left]; j < last; ++j) {
            const real4 off = offset(landmark[j], place);
            if (near(off, turned, feature))
                match = with_landmark(match, &sum, log_detection(off, turned, feature, signature[j], terms, arcs), j);
        }
    }
#if MARGINAL
    if (!isinf(match.found)) match.found += log(sum.x + sum.y);
#else
    match.found = match.best;
#endif
    return match;
}

// One work-item a particle: the sum of log p over features, with the partner that is KNOWN, of all landmarks (MARGINAL), or
// of the likeliest one. With PER_BEAM also what each feature adds, and its likeliest landmark's place in the buckets, -1
// where a false positive is likelier. share is log(1 / landmarks), the prior of each one with MARGINAL and else 0.
kernel void score_features(global const real4 *landmark, global const real4 *signature, global const int *start,
                           global const int2 *pose_cell, global const real4 *pose, global const real4 *pose_low,
                           global const real *feature, global const int *partner, global const real *terms,
                           global const real2 *arcs, global real *log_p, global real *parts, global int *which,
                           const int rows, const int cols, const int landmarks, const int particles,
                           const int features, const real size, const real share, const real fixed,
                           const real temperature) {
    const int n = get_global_id(0);
    if (n >= particles) return;
    const real4 own = pose[n], low = pose_low[n], place = sensor_place(pose_cell[n], own, low, size);
    real2 total = (real2)(fixed, 0);
    int lost = 0;
    for (int first = 0; first < features; first += BLOCK_TERMS) {
        const int last = min(first + BLOCK_TERMS, features);
        real block = 0;
        for (int k = first; k < last; ++k) {
            global const real *one = feature + FEATURE * k;
            const real4 turned = direction(own, low, one);
#if KNOWN
            const int j = partner[k];
            const real found = log_detection(offset(landmark[j], place), turned, one, signature[j], terms, arcs);
            const Match match = {found, found, j};
#else
            const Match match = search(landmark, signature, start, place, turned, one, terms, arcs, rows, cols, size);
#endif
            const real value = either(match.found + share, one[FALSE_POSITIVE]);
            lost |= isinf(value);
            block += isinf(value) ? (real)0 : value;
#if PER_BEAM
            parts[(long)n * features + k] = value;
#if KNOWN
            which[(long)n * features + k] = j;
#else
            which[(long)n * features + k] = match.best + share >= one[FALSE_POSITIVE] ? match.chosen : -1;
#endif
#endif
        }
        total = add_term(total, block);
    }
    log_p[n] = lost ? -INFINITY : temperature * (total.x + total.y);
}
