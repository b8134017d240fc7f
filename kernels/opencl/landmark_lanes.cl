// The landmark model for 16 particles at once: the functions of landmarks.cl and landmark_grid.cl in lanes, for features with
// ranges and bearings that are seen all around. Every lane has the arithmetic of the scalar kernel but for exp, log and erf,
// the arc tangent, which has the arcs of 0 and 1 only, and products whose rests fused operations find.
// requires: error_free lanes lane_math landmarks landmark_grid

#if WIDE
// A sum of two numbers, and a place, an offset or a direction in lanes.
typedef struct {
    lanes hi, lo;
} Two;
typedef struct {
    Two x, y;
} Spot;

// tan(pi/8); pi/4, pi/2 and pi in two parts.
#define EIGHTH_SLOPE 0.414213562f
#define EIGHTH_TURN 0.785398185f
#define EIGHTH_TURN_LOW -2.18556941e-08f
#define QUARTER_TURN 1.57079637f
#define QUARTER_TURN_LOW -4.37113883e-08f
#define HALF_TURN 3.14159274f
#define HALF_TURN_LOW -8.74227766e-08f
// Landmarks that 16 particles look at together, at most so many times as many as each of them.
#define TOGETHER 16

Two lane_sum(const lanes a, const lanes b) {
    const lanes sum = a + b, shift = sum - a;
    return (Two){sum, (a - (sum - shift)) + (b - shift)};
}

Two lane_product(const lanes a, const lanes b) {
    const lanes product = a * b;
    return (Two){product, fma(a, b, -product)};
}

// c - a, a positive number in two parts less another.
Two lane_rest(const float c, const float c_low, const Two a) {
    const Two sum = lane_sum((lanes)c, -a.hi);
    return lane_sum(sum.hi, sum.lo + (c_low - a.lo));
}

Spot lane_direction(const Spot heading, global const real *feature) {
    const float c = feature[COSINE], s = feature[SINE], c_low = feature[COSINE_LOW], s_low = feature[SINE_LOW];
    const Two cc = lane_product(heading.x.hi, (lanes)c), ss = lane_product(heading.y.hi, (lanes)s);
    const Two cs = lane_product(heading.x.hi, (lanes)s), sc = lane_product(heading.y.hi, (lanes)c);
    Spot turned = {lane_sum(cc.hi, -ss.hi), lane_sum(sc.hi, cs.hi)};
    turned.x.lo += (cc.lo - ss.lo) +
                   ((heading.x.hi * c_low + heading.x.lo * c) - (heading.y.hi * s_low + heading.y.lo * s));
    turned.y.lo += (sc.lo + cs.lo) +
                   ((heading.y.hi * c_low + heading.y.lo * c) + (heading.x.hi * s_low + heading.x.lo * s));
    return turned;
}

Spot lane_offset(const real4 landmark, const Spot place) {
    const Two x = lane_sum((lanes)landmark.x, -place.x.hi), y = lane_sum((lanes)landmark.y, -place.y.hi);
    return (Spot){lane_sum(x.hi, x.lo + (landmark.z - place.x.lo)), lane_sum(y.hi, y.lo + (landmark.w - place.y.lo))};
}

Two lane_distance(const Spot off) {
    const Two xx = lane_product(off.x.hi, off.x.hi), yy = lane_product(off.y.hi, off.y.hi);
    const Two sum = lane_sum(xx.hi, yy.hi);
    const lanes d = sqrt(sum.hi);
    const Two dd = lane_product(d, d);
    const lanes rest = (sum.hi - dd.hi) + ((sum.lo + ((xx.lo + yy.lo) - dd.lo)) +
                                           2.0f * (off.x.hi * off.x.lo + off.y.hi * off.y.lo));
    return (Two){d, d > 0 ? rest / (2.0f * d) : (lanes)0};
}

// Size of the angle of an offset from a direction, in [0, pi].
Two lane_angle(const Spot off, const Spot turned) {
    const Two right = lane_product(turned.x.hi, off.y.hi), left = lane_product(turned.y.hi, off.x.hi);
    const Two forth = lane_product(turned.x.hi, off.x.hi), more = lane_product(turned.y.hi, off.y.hi);
    Two side = lane_sum(right.hi, -left.hi), ahead = lane_sum(forth.hi, more.hi);
    side.lo += (right.lo - left.lo) + ((turned.x.hi * off.y.lo + turned.x.lo * off.y.hi) -
                                       (turned.y.hi * off.x.lo + turned.y.lo * off.x.hi));
    ahead.lo += (forth.lo + more.lo) + ((turned.x.hi * off.x.lo + turned.x.lo * off.x.hi) +
                                        (turned.y.hi * off.y.lo + turned.y.lo * off.y.hi));
    const ilanes behind = ahead.hi < 0, under = side.hi < 0;
    const Two a = {behind ? -ahead.hi : ahead.hi, behind ? -ahead.lo : ahead.lo};
    const Two b = {under ? -side.hi : side.hi, under ? -side.lo : side.lo};
    const ilanes steep = b.hi > a.hi;
    Two num = {steep ? a.hi : b.hi, steep ? a.lo : b.lo}, den = {steep ? b.hi : a.hi, steep ? b.lo : a.lo};
    const ilanes large = num.hi > EIGHTH_SLOPE * den.hi;
    if (some(large)) {
        // (num - den) / (num + den) is the slope from 1 on.
        const Two less = lane_sum(num.hi, -den.hi), sum = lane_sum(den.hi, num.hi);
        num = (Two){large ? less.hi : num.hi, large ? less.lo + (num.lo - den.lo) : num.lo};
        den = (Two){large ? sum.hi : den.hi, large ? sum.lo + (den.lo + num.lo) : den.lo};
    }
    const lanes one_over = 1.0f / den.hi, t = num.hi * one_over;
    const lanes t_low = (fma(-t, den.hi, num.hi) + (num.lo - t * den.lo)) * one_over;
    const Two sum = lane_sum(large ? (lanes)EIGHTH_TURN : (lanes)0, t);
    Two arc = lane_sum(sum.hi, sum.lo + ((large ? (lanes)EIGHTH_TURN_LOW : (lanes)0) + (t_low + arc_rest(t))));
    if (some(steep)) {
        const Two rest = lane_rest(QUARTER_TURN, QUARTER_TURN_LOW, arc);
        arc = (Two){steep ? rest.hi : arc.hi, steep ? rest.lo : arc.lo};
    }
    if (some(behind)) {
        const Two rest = lane_rest(HALF_TURN, HALF_TURN_LOW, arc);
        arc = (Two){behind ? rest.hi : arc.hi, behind ? rest.lo : arc.lo};
    }
    return arc;
}

// (residual * scale)^2 added to an exponent.
Two lane_add_square(const Two total, const Two residual, const float scale, const float scale_low) {
    const Two u = lane_product(residual.hi, (lanes)scale);
    const lanes u_low = u.lo + (residual.hi * scale_low + residual.lo * scale);
    const Two square = lane_product(u.hi, u.hi), sum = lane_sum(total.hi, square.hi);
    const lanes low = sum.lo + (total.lo + (square.lo + 2.0f * u.hi * u_low));
    // What overflows has no low part.
    return (Two){sum.hi, low - low == 0 ? low : (lanes)0};
}

lanes lane_detection(const Spot off, const Spot turned, global const real *feature, global const real *terms) {
    Two exponent = {0, 0};
    lanes mass = 1;
    const Two d = lane_distance(off);
#if RANGE
    if (feature[RANGE_SCALE] > 0) {
        const float scale = feature[RANGE_SCALE];
        const Two r = lane_sum(d.hi, (lanes)-feature[RANGE_AT]);
        exponent = lane_add_square(exponent, lane_sum(r.hi, r.lo + (d.lo - feature[RANGE_LOW])), scale,
                                   feature[RANGE_SCALE_LOW]);
        const lanes inside = d.hi < terms[0] ? d.hi : (lanes)terms[0];
        const lanes left = (terms[0] - d.hi) + (terms[1] - d.lo);
        const lanes below = inside * scale, above = (left > 0 ? left : (lanes)0) * scale;
        if (some((below < above ? below : above) < (float)ERF_ONE))
            mass = 0.5f * (erf_lanes(below) + erf_lanes(above));
    }
#endif
#if BEARING
    if (feature[BEARING_SCALE] > 0) {
        const ilanes there = d.hi > (float)ZERO_RANGE;
        const Two more =
            lane_add_square(exponent, lane_angle(off, turned), feature[BEARING_SCALE], feature[BEARING_SCALE_LOW]);
        exponent = (Two){there ? more.hi : exponent.hi, there ? more.lo : exponent.lo};
        mass = there ? mass : mass * (terms[3] * feature[BEARING_SCALE]);
    }
#endif
    const lanes log_p = (feature[PEAK] - exponent.hi) + (feature[PEAK_LOW] - exponent.lo);
    return some(mass != 1) ? (mass == 1 ? log_p : log_p - log_lanes(mass)) : log_p;
}

// log(a + b), where a is a logarithm and so is b; -inf only where both are.
lanes lane_either(const lanes detected, const float false_positive) {
    const ilanes larger = detected > false_positive;
    const lanes high = larger ? detected : (lanes)false_positive, low = larger ? (lanes)false_positive : detected;
    const lanes small = exp_lanes(low - high), sum = 1.0f + small;
    const lanes found = high + (log_lanes(sum) + (small - (sum - 1.0f)) / sum);
    return high > -INFINITY ? found : high;
}

// Least and largest of lanes.
real2 lane_ends(const lanes a) {
    real each[LANES];
    store_lanes(a, 0, each);
    real2 ends = (real2)(each[0], each[0]);
    for (int i = 1; i < LANES; ++i) ends = (real2)(fmin(ends.x, each[i]), fmax(ends.y, each[i]));
    return ends;
}

// One more landmark: the best log densities so far, and the squared radius of what may still be likelier.
void lane_landmark(const real4 landmark, const Spot place, const Spot turned, const lanes end_x, const lanes end_y,
                   global const real *feature, global const real *terms, lanes *best, lanes *most) {
    // The disc is wide enough for what is rounded here.
    const lanes apart_x = landmark.x - end_x, apart_y = landmark.y - end_y;
    const lanes apart = apart_x * apart_x + apart_y * apart_y;
    if (!some(apart <= *most)) return;
    const float hole = feature[HOLE] * feature[HOLE], farthest = feature[FARTHEST] * feature[FARTHEST];
    const Spot off = lane_offset(landmark, place);
    const lanes squared = off.x.hi * off.x.hi + off.y.hi * off.y.hi;
    const ilanes seen = (apart <= *most) & (squared >= hole) & (squared <= farthest);
    if (!some(seen)) return;
    const lanes log_p = lane_detection(off, turned, feature, terms);
    *best = (seen & (log_p > *best)) ? log_p : *best;
    const float reach = feature[REACH];
    if (reach > 0 && reach == feature[RANGE_AT]) {
        const lanes rest = feature[MOST] - *best, root = sqrt(rest > 0 ? rest : (lanes)0);
        const lanes r = root * feature[RANGE_SPREAD], b = root * feature[BEARING_SPREAD];
        const lanes far = 1.01f * (r * r + reach * (reach + r) * (b * b)) + feature[SLACK];
        *most = far < *most ? far : *most;
    }
}

// The landmarks of some buckets: that nearest to (x, y), the middle of the end points, comes first, since most others are
// then too far to be likelier.
void lane_buckets(global const real4 *landmark, global const int *start, const int4 buckets, const int cols,
                  const float x, const float y, const Spot place, const Spot turned, const lanes end_x,
                  const lanes end_y, global const real *feature, global const real *terms, lanes most, lanes *best) {
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
    lane_landmark(landmark[nearest], place, turned, end_x, end_y, feature, terms, best, &most);
    for (int row = buckets.z; row <= buckets.w; ++row) {
        const int last = start[row * cols + buckets.y + 1];
        for (int j = start[row * cols + buckets.x]; j < last; ++j)
            if (j != nearest) lane_landmark(landmark[j], place, turned, end_x, end_y, feature, terms, best, &most);
    }
}

// First and last column and row of the buckets that discs touch.
int4 lane_touched(const real2 x, const real2 y, const float radius, const int rows, const int cols, const float size) {
    return (int4)(bucket_at(x.x - radius, size, cols), bucket_at(x.y + radius, size, cols),
                  bucket_at(y.x - radius, size, rows), bucket_at(y.y + radius, size, rows));
}

// Log densities of the likeliest landmarks. Where the discs of the particles touch few more buckets together than each of
// them alone, the particles look at landmarks together, else one after the other; a lane has the same bits either way.
lanes lane_search(global const real4 *landmark, global const int *start, const Spot place, const Spot turned,
                  global const real *feature, global const real *terms, const int rows, const int cols,
                  const real size) {
    const real radius = feature[RADIUS];
    lanes best = -INFINITY;
    if (radius < 0) return best;
    const lanes end_x = place.x.hi + feature[REACH] * turned.x.hi, end_y = place.y.hi + feature[REACH] * turned.y.hi;
    const real2 x = lane_ends(end_x), y = lane_ends(end_y);
    const int4 all = lane_touched(x, y, radius, rows, cols, size);
    const int across = min((int)(2 * fmin(radius, size * cols) / size) + 2, cols);
    const int up = min((int)(2 * fmin(radius, size * rows) / size) + 2, rows);
    const lanes most = radius * radius;
    if ((long)(all.y - all.x + 1) * (all.w - all.z + 1) <= TOGETHER * (long)across * up) {
        lane_buckets(landmark, start, all, cols, 0.5f * (x.x + x.y), 0.5f * (y.x + y.y), place, turned, end_x, end_y,
                     feature, terms, most, &best);
        return best;
    }
    real each_x[LANES], each_y[LANES];
    store_lanes(end_x, 0, each_x);
    store_lanes(end_y, 0, each_y);
    for (int i = 0; i < LANES; ++i) {
        const int4 own = lane_touched((real2)each_x[i], (real2)each_y[i], radius, rows, cols, size);
        const ilanes mine = (ilanes)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15) == i;
        // No square is negative, so nothing matters to the others.
        lane_buckets(landmark, start, own, cols, each_x[i], each_y[i], place, turned, end_x, end_y, feature, terms,
                     mine ? most : (lanes)-1, &best);
    }
    return best;
}
#endif
