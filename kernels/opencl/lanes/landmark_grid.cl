// Search for the landmarks near the end points of a feature for LANES particles at once: landmark_grid.cl in lanes.
// requires: landmark_grid lanes/buckets lanes/landmarks

// Particles search together unless that visits more than TOGETHER times the buckets of a single search.
#define TOGETHER 16

// Return the smallest and the largest of the lanes.
real2 ends_of_lanes(const lanes a) {
    const float8 low = a.lo < a.hi ? a.lo : a.hi, high = a.lo < a.hi ? a.hi : a.lo;
    const float4 less = low.lo < low.hi ? low.lo : low.hi, more = high.lo < high.hi ? high.hi : high.lo;
    const float2 least = less.lo < less.hi ? less.lo : less.hi, most = more.lo < more.hi ? more.hi : more.lo;
    return (real2)(least.x < least.y ? least.x : least.y, most.x < most.y ? most.y : most.x);
}

// Results of a search: the log densities, of the likeliest landmarks or with MARGINAL of all of them; the log densities
// of the likeliest ones, and with PER_BEAM their indices. MARGINAL: sum is the sum of densities relative to log_p. most
// is the squared radius around an end point within which another landmark may be likelier.
typedef struct {
    lanes log_p, best, most;
    ilanes chosen;
    LanePair sum;
} MatchLanes;

// Update the matches by one more landmark in those lanes that see it. Of equally likely ones the first counts.
void with_density_lanes(MatchLanes *match, const ilanes seen, const lanes log_p, const int j) {
#if MARGINAL
    const ilanes taken = seen & (log_p > -INFINITY), larger = taken & (log_p > match->log_p + RELATIVE);
    const lanes other = exp_lanes(larger ? match->log_p - log_p : log_p - match->log_p);
    const LanePair more = two_sum_lanes(match->sum.x, other);
    const lanes high = larger ? match->sum.x * other + 1 : more.x;
    const lanes low = larger ? match->sum.y * other : match->sum.y + more.y;
    match->sum = (LanePair){taken ? high : match->sum.x, taken ? low : match->sum.y};
    match->log_p = larger ? log_p : match->log_p;
#endif
#if PER_BEAM
    const ilanes better = seen & ((log_p > match->best) | ((log_p == match->best) & (j < match->chosen)));
    match->best = better ? log_p : match->best;
    match->chosen = better ? (ilanes)j : match->chosen;
#else
    match->best = (seen & (log_p > match->best)) ? log_p : match->best;
#endif
}

#if !MARGINAL
// in lanes: squared_reach

// Return the lanes in which a landmark at an offset may be likelier than the best so far. The error of the range and
// the sine of the bearing's error bound the exponent from below; margins cover rounding errors, and landmarks without a
// bearing at zero range.
ilanes may_be_likelier(const LaneQuad off, const lanes d, const LaneQuad turned, const lanes best,
                       global const real *feature) {
    const float at = feature[RANGE_AT];
    const lanes rest = feature[MOST] - best, beyond = d - at;
    const lanes side = turned.x * off.z - turned.z * off.x;
    const lanes away = (beyond < 0 ? -beyond : beyond) - 1e-6f * (d + at), across = (side < 0 ? -side : side) - 1e-6f * d;
    const lanes r = (away > 0 ? away : (lanes)0) * feature[RANGE_SCALE];
    const lanes b = (across > 0 ? across : (lanes)0) * feature[BEARING_SCALE] / d;
    return ~(r * r + b * b > 1.01f * (rest > 0 ? rest : (lanes)0) + 0.01f) | (d <= (float)ZERO_RANGE);
}
#endif

// Update the matches by landmark j, where it is in a feature's disc, within the limits of the sensor that the feature
// does not measure, and may be likelier than the best so far.
void with_landmark_lanes(MatchLanes *match, global const real4 *landmark, global const real4 *signature, const int j,
                         const LaneQuad place, const LaneQuad turned, const lanes end_x, const lanes end_y,
                         global const real *feature, global const FeatureTerms *terms, global const real2 *arcs) {
    // The disc has room for these rounding errors.
    const real4 here = landmark[j];
    const lanes apart_x = here.x - end_x, apart_y = here.y - end_y;
    const lanes apart = apart_x * apart_x + apart_y * apart_y;
    if (!any_lane(apart <= match->most)) return;
    const float hole = feature[HOLE] * feature[HOLE], farthest = feature[FARTHEST] * feature[FARTHEST];
    const LaneQuad off = offset_lanes(in_all_lanes(here), place);
    const lanes squared = off.x * off.x + off.z * off.z;
    ilanes seen = (apart <= match->most) & (squared >= hole) & (squared <= farthest);
    const lanes d = sqrt(squared);
#if FIELD
    seen &= turned.x * off.x + turned.z * off.z >= feature[AXIS] * d;
#endif
#if !MARGINAL
    seen &= may_be_likelier(off, d, turned, match->best, feature);
#endif
    if (!any_lane(seen)) return;
    with_density_lanes(match, seen, log_detection_lanes(off, turned, feature, signature + j, terms, arcs), j);
#if !MARGINAL
    const float reach = feature[REACH];
    if (reach > 0 && reach == feature[RANGE_AT]) {
        const lanes far = squared_reach_lanes(feature[MOST] - match->best, feature);
        match->most = far < match->most ? far : match->most;
    }
#endif
}

// Return whether a landmark lies beyond a radius around each end point: none is outside of the intervals x and y. Rounded
// differences and squares grow with exact ones, so no end point's squared distance is smaller.
int is_beyond(const real4 here, const real2 x, const real2 y, const float squared_radius) {
    const float left = x.x - here.x, right = here.x - x.y, below = y.x - here.y, above = here.y - y.y;
    const float across = left > right ? left : right, along = below > above ? below : above;
    return (across > 0 ? across * across : 0) + (along > 0 ? along * along : 0) > squared_radius;
}

// Search the landmarks of some buckets. The landmark nearest to the middle of the end points (in the intervals x and y)
// comes first: after it most others are too far to be likelier. Sums have the order of the landmarks, which does not
// depend on the other lanes.
void search_buckets_lanes(MatchLanes *match, global const real4 *landmark, global const real4 *signature,
                          global const int *start, const int4 buckets, const int cols, const real2 x, const real2 y,
                          const LaneQuad place, const LaneQuad turned, const lanes end_x, const lanes end_y,
                          global const real *feature, global const FeatureTerms *terms, global const real2 *arcs) {
    const float squared_radius = feature[RADIUS] * feature[RADIUS];
    int nearest = -1;
#if !MARGINAL
    const float middle_x = 0.5f * (x.x + x.y), middle_y = 0.5f * (y.x + y.y);
    float least = INFINITY;
    for (int row = buckets.z; row <= buckets.w; ++row) {
        const int last = start[row * cols + buckets.y + 1];
        for (int j = start[row * cols + buckets.x]; j < last; ++j) {
            const float off_x = landmark[j].x - middle_x, off_y = landmark[j].y - middle_y;
            const float squared = off_x * off_x + off_y * off_y;
            nearest = squared < least ? j : nearest;
            least = squared < least ? squared : least;
        }
    }
    if (nearest < 0) return;
    with_landmark_lanes(match, landmark, signature, nearest, place, turned, end_x, end_y, feature, terms,
                        arcs);
#endif
    for (int row = buckets.z; row <= buckets.w; ++row) {
        const int last = start[row * cols + buckets.y + 1];
        for (int j = start[row * cols + buckets.x]; j < last; ++j)
            if (j != nearest && !is_beyond(landmark[j], x, y, squared_radius))
                with_landmark_lanes(match, landmark, signature, j, place, turned, end_x, end_y, feature, terms,
                        arcs);
    }
}

// Return the matches of a feature. Where the discs of all particles touch few more buckets together than each disc
// alone, the particles search together, else one after the other. A lane has the same bits in both cases.
MatchLanes search_lanes(global const real4 *landmark, global const real4 *signature, global const int *start,
                        const LaneQuad place, const LaneQuad turned, global const real *feature,
                        global const FeatureTerms *terms, global const real2 *arcs, const Buckets buckets) {
    const real radius = feature[RADIUS];
    MatchLanes match = {-INFINITY, -INFINITY, -1, -1, {0, 0}};
    if (radius < 0) return match;
    const lanes end_x = place.x + feature[REACH] * turned.x, end_y = place.z + feature[REACH] * turned.z;
    const real2 x = ends_of_lanes(end_x), y = ends_of_lanes(end_y);
    const int4 all = touched_buckets(x, y, radius, buckets);
    const int across = min((int)(2 * fmin(radius, buckets.size * buckets.cols) / buckets.size) + 2, buckets.cols);
    const int up = min((int)(2 * fmin(radius, buckets.size * buckets.rows) / buckets.size) + 2, buckets.rows);
    if ((long)(all.y - all.x + 1) * (all.w - all.z + 1) <= TOGETHER * (long)across * up) {
        match.most = radius * radius;
        search_buckets_lanes(&match, landmark, signature, start, all, buckets.cols, x, y, place, turned, end_x, end_y,
                             feature, terms, arcs);
    } else {
        real each_x[LANES], each_y[LANES];
        store_lanes(end_x, 0, each_x);
        store_lanes(end_y, 0, each_y);
        for (int i = 0; i < LANES; ++i) {
            const real2 x_only = each_x[i], y_only = each_y[i];
            const int4 touched = touched_buckets(x_only, y_only, radius, buckets);
            const ilanes active = (ilanes)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15) == i;
            // No squared distance is negative, so the other lanes find nothing.
            match.most = active ? (lanes)(radius * radius) : (lanes)-1;
            search_buckets_lanes(&match, landmark, signature, start, touched, buckets.cols, x_only, y_only, place,
                                 turned, end_x, end_y, feature, terms,
                        arcs);
        }
    }
#if MARGINAL
    const ilanes any_found = match.log_p > -INFINITY;
    if (any_lane(any_found)) {
        const lanes sum = match.sum.x + match.sum.y;
        match.log_p = any_found ? match.log_p + log_lanes(any_found ? sum : (lanes)1) : match.log_p;
    }
#else
    match.log_p = match.best;
#endif
    return match;
}
