// Search for the landmarks near the end points of a feature for LANES particles at once: landmark_grid.cl in lanes.
// requires: landmark_grid lanes/landmarks

// Particles search together unless that visits more than TOGETHER times the buckets of a single search.
#define TOGETHER 16

// Return the smallest and the largest of the lanes.
real2 ends_of_lanes(const lanes a) {
    real each[LANES];
    store_lanes(a, 0, each);
    real2 ends = (real2)(each[0], each[0]);
    for (int i = 1; i < LANES; ++i) ends = (real2)(fmin(ends.x, each[i]), fmax(ends.y, each[i]));
    return ends;
}

// Update the best log densities by one more landmark, and the squared radius within which another may be likelier.
void with_landmark_lanes(const real4 landmark, const LanePlace place, const LanePlace turned, const lanes end_x,
                         const lanes end_y, global const real *feature, global const real *terms, lanes *best,
                         lanes *most) {
    // The disc has room for these rounding errors.
    const lanes apart_x = landmark.x - end_x, apart_y = landmark.y - end_y;
    const lanes apart = apart_x * apart_x + apart_y * apart_y;
    if (!any_lane(apart <= *most)) return;
    const float hole = feature[HOLE] * feature[HOLE], farthest = feature[FARTHEST] * feature[FARTHEST];
    const LanePlace off = offset_lanes(landmark, place);
    const lanes squared = off.x.hi * off.x.hi + off.y.hi * off.y.hi;
    const ilanes seen = (apart <= *most) & (squared >= hole) & (squared <= farthest);
    if (!any_lane(seen)) return;
    const lanes log_p = log_detection_lanes(off, turned, feature, terms);
    *best = (seen & (log_p > *best)) ? log_p : *best;
    const float reach = feature[REACH];
    if (reach > 0 && reach == feature[RANGE_AT]) {
        const lanes rest = feature[MOST] - *best, root = sqrt(rest > 0 ? rest : (lanes)0);
        const lanes r = root * feature[RANGE_SPREAD], b = root * feature[BEARING_SPREAD];
        const lanes far = 1.01f * (r * r + reach * (reach + r) * (b * b)) + feature[SLACK];
        *most = far < *most ? far : *most;
    }
}

// Search the landmarks of some buckets. The landmark nearest to (x, y), the middle of the end points, comes first:
// after it most others are too far to be likelier.
void search_buckets_lanes(global const real4 *landmark, global const int *start, const int4 buckets, const int cols,
                          const float x, const float y, const LanePlace place, const LanePlace turned,
                          const lanes end_x, const lanes end_y, global const real *feature, global const real *terms,
                          lanes most, lanes *best) {
    int nearest = -1;
    float least = INFINITY;
    for (int row = buckets.z; row <= buckets.w; ++row) {
        const int last = start[row * cols + buckets.y + 1];
        for (int j = start[row * cols + buckets.x]; j < last; ++j) {
            const float off_x = landmark[j].x - x, off_y = landmark[j].y - y, squared = off_x * off_x + off_y * off_y;
            nearest = squared < least ? j : nearest;
            least = squared < least ? squared : least;
        }
    }
    if (nearest < 0) return;
    with_landmark_lanes(landmark[nearest], place, turned, end_x, end_y, feature, terms, best, &most);
    for (int row = buckets.z; row <= buckets.w; ++row) {
        const int last = start[row * cols + buckets.y + 1];
        for (int j = start[row * cols + buckets.x]; j < last; ++j)
            if (j != nearest) with_landmark_lanes(landmark[j], place, turned, end_x, end_y, feature, terms, best,
                                                  &most);
    }
}

// Return the first and last column, and the first and last row, of the buckets that discs touch.
int4 touched_buckets(const real2 x, const real2 y, const float radius, const Buckets buckets) {
    const int left = bucket_at(x.x - radius, buckets.size, buckets.cols);
    const int right = bucket_at(x.y + radius, buckets.size, buckets.cols);
    const int low = bucket_at(y.x - radius, buckets.size, buckets.rows);
    return (int4)(left, right, low, bucket_at(y.y + radius, buckets.size, buckets.rows));
}

// Return the log densities of the likeliest landmarks. Where the discs of all particles touch few more buckets together
// than each disc alone, the particles search together, else one after the other. A lane has the same bits in both
// cases.
lanes search_lanes(global const real4 *landmark, global const int *start, const LanePlace place, const LanePlace turned,
                   global const real *feature, global const real *terms, const Buckets buckets) {
    const real radius = feature[RADIUS];
    lanes best = -INFINITY;
    if (radius < 0) return best;
    const lanes end_x = place.x.hi + feature[REACH] * turned.x.hi, end_y = place.y.hi + feature[REACH] * turned.y.hi;
    const real2 x = ends_of_lanes(end_x), y = ends_of_lanes(end_y);
    const int4 all = touched_buckets(x, y, radius, buckets);
    const int across = min((int)(2 * fmin(radius, buckets.size * buckets.cols) / buckets.size) + 2, buckets.cols);
    const int up = min((int)(2 * fmin(radius, buckets.size * buckets.rows) / buckets.size) + 2, buckets.rows);
    const lanes most = radius * radius;
    if ((long)(all.y - all.x + 1) * (all.w - all.z + 1) <= TOGETHER * (long)across * up) {
        search_buckets_lanes(landmark, start, all, buckets.cols, 0.5f * (x.x + x.y), 0.5f * (y.x + y.y), place, turned,
                             end_x, end_y, feature, terms, most, &best);
        return best;
    }
    real each_x[LANES], each_y[LANES];
    store_lanes(end_x, 0, each_x);
    store_lanes(end_y, 0, each_y);
    for (int i = 0; i < LANES; ++i) {
        const int4 touched = touched_buckets((real2)each_x[i], (real2)each_y[i], radius, buckets);
        const ilanes active = (ilanes)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15) == i;
        // No squared distance is negative, so the other lanes find nothing.
        search_buckets_lanes(landmark, start, touched, buckets.cols, each_x[i], each_y[i], place, turned, end_x, end_y,
                             feature, terms, active ? most : (lanes)-1, &best);
    }
    return best;
}
