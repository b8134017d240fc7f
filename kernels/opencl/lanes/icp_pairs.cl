// Pairs of point-to-line ICP for LANES points of a scan at once: icp_pairs.cl. The points of a block are neighbours in
// bearing, and so are their nearest points: all of them are compared with one point of the reference after another,
// first with points between their bearings, then with points outside that may be nearer than the nearest so far.
// requires: icp_step lanes/math

// tan(pi / 8). arcsin s < s + ARCSIN s^3. Errors of bearings are far below BEARING_ERROR.
#define TAN_EIGHTH 0.414213562f
#define ARCSIN 0.571f
#define BEARING_ERROR 1e-5f
// Scans of up to this many points are searched completely.
#define FEW_POINTS 64

// Return the smallest lane.
real least_lane(const lanes a) {
    const float8 eight = a.lo < a.hi ? a.lo : a.hi;
    const float4 four = eight.lo < eight.hi ? eight.lo : eight.hi;
    const float2 two = four.lo < four.hi ? four.lo : four.hi;
    return two.x < two.y ? two.x : two.y;
}

// Return the bearings of places in [0, 2 pi].
lanes bearing_lanes(const lanes x, const lanes y) {
    const lanes a = as_lanes(size_bits(x)), b = as_lanes(size_bits(y));
    const ilanes steep = b > a;
    const lanes low = steep ? a : b, high = (steep ? b : a) + 1e-30f;
    // Above tan(pi/8): arctan t = pi/4 + arctan((t - 1) / (t + 1)).
    const ilanes wide = low > TAN_EIGHTH * high;
    const lanes t = (wide ? low - high : low) / (wide ? low + high : high);
    const lanes arc = t + arc_rest_lanes(t) + (wide ? (lanes)(FULL_TURN / 8) : (lanes)0);
    const lanes quarter = steep ? FULL_TURN / 4 - arc : arc, above = x < 0.0f ? FULL_TURN / 2 - quarter : quarter;
    return y < 0.0f ? FULL_TURN - above : above;
}

// Return the bearing of the i-th point of a scan; points repeat turn after turn, and i is from -count to
// 2 count.
real turned_bearing(global const real4 *point, const int count, const int skip, const int i) {
    return i < 0 ? point[skip * (i + count)].z - FULL_TURN
                 : i >= count ? point[skip * (i - count)].z + FULL_TURN : point[skip * i].z;
}

// Compare with the points from one to before another, and keep those that are nearer; see turned_bearing.
void compare_lanes(global const real4 *point, const int count, const int skip, const int from, const int to,
                   const lanes x, const lanes y, lanes *best, ilanes *which) {
    lanes least = *best;
    ilanes nearest = *which;
    for (int begin = from; begin < to;) {
        const int shift = begin < 0 ? count : begin >= count ? -count : 0;
        const int end = min(to, begin < 0 ? 0 : begin >= count ? 2 * count : count);
        for (int i = skip * (begin + shift); i < skip * (end + shift); i += skip) {
            const real2 p = point[i].xy;
            const lanes dx = p.x - x, dy = p.y - y, distance = dx * dx + dy * dy;
            const ilanes nearer = distance < least;
            least = nearer ? distance : least;
            nearest = nearer ? (ilanes)i : nearest;
        }
        begin = end;
    }
    *best = least;
    *which = nearest;
}

// Return the nearest of every skip-th point of a scan that are nearer than the square root of squared, -1 without one.
// The search begins at *hint, which becomes a good beginning for the next block.
ilanes nearest_lanes(global const real4 *point, const int count, const int skip, const lanes x, const lanes y,
                     const real squared, int *hint) {
    const int kept = (count + skip - 1) / skip;
    lanes best = squared;
    ilanes which = -1;
    if (kept <= FEW_POINTS) {
        compare_lanes(point, kept, skip, 0, kept, x, y, &best, &which);
        return which;
    }
    const lanes bearing = bearing_lanes(x, y);
    lanes from = bearing - bearing.s0;
    from = from > 0.5f * FULL_TURN ? from - FULL_TURN : from;
    from = from < -0.5f * FULL_TURN ? from + FULL_TURN : from;
    const real low = bearing.s0 + least_lane(from), turn = low < 0 ? FULL_TURN : low >= FULL_TURN ? -FULL_TURN : 0;
    // Bearings of the block relative to the smallest one, itself in [0, 2 pi).
    from += bearing.s0 - low;
    const real first = low + turn, high = first - least_lane(-from);
    const int begin = points_before(point, kept, skip, first, min(*hint, kept));
    int end = begin;
    while (end < begin + kept && turned_bearing(point, kept, skip, end) <= high) ++end;
    *hint = end < kept ? end : end - kept;
    compare_lanes(point, kept, skip, begin, end, x, y, &best, &which);
    const lanes share = best / (x * x + y * y + 1e-30f), sine = sqrt(share);
    const lanes width = share < 1.0f ? sine + sine * share * ARCSIN + BEARING_ERROR : (lanes)FULL_TURN;
    const real last = first - least_lane(-(from + width)), earliest = first + least_lane(from - width);
    int top = end, bottom = begin;
    while (top < begin + kept && turned_bearing(point, kept, skip, top) <= last) ++top;
    while (bottom > top - kept && turned_bearing(point, kept, skip, bottom - 1) >= earliest) --bottom;
    compare_lanes(point, kept, skip, end, top, x, y, &best, &which);
    compare_lanes(point, kept, skip, bottom, begin, x, y, &best, &which);
    return which;
}

// Add pairs of lines and places that are counted (1, others 0), and return their weighted errors; arm is the place
// relative to the second scan's origin.
lanes add_pairing_lanes(lanes *sums, const lanes *line, const lanes x, const lanes y, const lanes arm_x,
                        const lanes arm_y, const real scale, const int last, const lanes counted) {
    const lanes error = line[0] * x + line[1] * y - line[2], ratio = error / scale;
    lanes weight = 1 / (1 + ratio * ratio);
    if (last) weight *= weight;
    weight *= counted;
    const lanes turn = line[1] * arm_x - line[0] * arm_y, along = line[0] * arm_x + line[1] * arm_y;
    const lanes doubt = weight * line[3], pull = weight * error;
    const lanes doubt_x = doubt * line[0], doubt_y = doubt * line[1], weight_x = weight * line[0];
    const lanes weight_y = weight * line[1];
    sums[0] += weight_x * line[0];
    sums[1] += weight_x * line[1];
    sums[2] += weight_x * turn;
    sums[3] += weight_y * line[1];
    sums[4] += weight_y * turn;
    sums[5] += weight * turn * turn;
    sums[6] -= pull * line[0];
    sums[7] -= pull * line[1];
    sums[8] -= pull * turn;
    sums[9] += doubt_y * line[1];
    sums[10] -= doubt_x * line[1];
    sums[11] -= doubt_y * along;
    sums[12] += doubt_x * line[0];
    sums[13] += doubt_x * along;
    sums[14] += doubt * along * along;
    sums[15] += weight;
    sums[16] += pull * error;
    sums[17] += counted;
    return pull;
}

// Return the points of a block from the first-th on, every stride-th; the last one is repeated for missing ones.
ilanes block_of(const int first, const int stride, const int count) {
    const ilanes i = first + stride * (ilanes)(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
    return i < count ? i : (ilanes)(count - 1);
}

// Write lines of points, and return 1 where there is one and 0 elsewhere.
lanes lines_lanes(global const real4 *line, const ilanes which, lanes *lines) {
    global const real *numbers = (global const real *)line;
    const ilanes at = 4 * (which < 0 ? (ilanes)0 : which);
    const int *i = (const int *)&at;
    for (int j = 0; j < 4; ++j) lines[j] = GATHER_AT(lanes, (numbers + j), i);
    return which >= 0 ? (lanes)1 : (lanes)0;
}

// Return how well every stride-th point of one scan agrees with every skip-th point of another scan; see icp_pairs.cl.
real4 agreement(global const real4 *point, global const real4 *line, const int count, global const real4 *other,
                const int others, const int stride, const int skip, const real4 pose, const real near, const real gap,
                const Team team) {
    const real scale = near / 3;
    global const real *numbers = (global const real *)other;
    lanes sum = 0, seen = 0;
    int hint = 0, ahead = 0;
    real4 all = (real4)(0);
    for (int i = 0; i < others; i += LANES * stride) {
        const ilanes block = block_of(i, stride, others), at = 4 * block;
        const int *k = (const int *)&at;
        const lanes p = GATHER_AT(lanes, numbers, k), q = GATHER_AT(lanes, (numbers + 1), k);
        const lanes x = pose.z * p - pose.w * q + pose.x, y = pose.w * p + pose.z * q + pose.y;
        const ilanes which = nearest_lanes(point, count, skip, x, y, near * near, &hint);
        lanes lines[4];
        const int size = min(LANES, (others - i + stride - 1) / stride);
        const lanes present = to_lanes(block_of(0, 1, LANES)) < (real)size ? (lanes)1 : (lanes)0;
        const lanes found = present * lines_lanes(line, which, lines);
        const lanes ratio = (lines[0] * x + lines[1] * y - lines[2]) / scale;
        sum += found / (1 + ratio * ratio);
        seen += found;
        if (!any_lane(which < 0)) continue;
        const lanes bearing = bearing_lanes(x, y);
        for (int l = 0; l < size; ++l) {
            if (((const int *)&which)[l] >= 0) continue;
            const real px = ((const real *)&x)[l], py = ((const real *)&y)[l];
            ahead = points_before(point, count, 1, ((const real *)&bearing)[l], ahead);
            const real4 low = point[ahead > 0 ? ahead - 1 : count - 1], high = point[ahead < count ? ahead : 0];
            const real between = high.z < low.z ? high.z - low.z + FULL_TURN : high.z - low.z;
            const real range = fmin(low.w, high.w);
            if (between <= gap && px * px + py * py < range * range)
                all.z += 1;
            else
                all.w += 1;
        }
    }
    return all + (real4)(sum_lanes(sum), sum_lanes(seen), 0, 0);
}

// Write the sums over the pairs of a scan's points at a pose (x, y, cos, sin), and the sums of blocks, 0 unless full.
void sum_pairs(global const real4 *point, global const real4 *line, const int count, global const real4 *other,
               const int others, const int stride, const int skip, const real4 pose, const real capture,
               const real scale, const int last, const int full, real *sums, real *squares, const Team team) {
    global const real *numbers = (global const real *)other;
    lanes total[MATCH_SUMS];
    int hint = 0;
    // Squares of blocks of 1, 2, 4 and 8 points within LANES of them.
    lanes one = 0;
    float8 two = 0;
    float4 four = 0;
    float2 eight = 0;
    real open[MATCH_BLOCKS];
    for (int i = 0; i < MATCH_SUMS; ++i) total[i] = 0;
    for (int i = 0; i < MATCH_BLOCKS; ++i) squares[i] = open[i] = 0;
    for (int i = 0; i < others; i += LANES * stride) {
        const ilanes block = block_of(i, stride, others), at = 4 * block;
        const int *k = (const int *)&at;
        const lanes px = GATHER_AT(lanes, numbers, k), py = GATHER_AT(lanes, (numbers + 1), k);
        const lanes arm_x = pose.z * px - pose.w * py, arm_y = pose.w * px + pose.z * py;
        const lanes x = arm_x + pose.x, y = arm_y + pose.y;
        const ilanes which = nearest_lanes(point, count, skip, x, y, capture * capture, &hint);
        lanes lines[4];
        const int size = min(LANES, (others - i + stride - 1) / stride);
        const lanes present = to_lanes(block_of(0, 1, LANES)) < (real)size ? (lanes)1 : (lanes)0;
        const lanes found = present * lines_lanes(line, which, lines);
        const lanes counted = lines[3] > 0.0f ? found : (lanes)0;
        const lanes pull = add_pairing_lanes(total, lines, x, y, arm_x, arm_y, scale, last, counted);
        if (!full) continue;
        const float8 by_two = pull.even + pull.odd;
        const float4 by_four = by_two.even + by_two.odd;
        const float2 by_eight = by_four.even + by_four.odd;
        one += pull * pull;
        two += by_two * by_two;
        four += by_four * by_four;
        eight += by_eight * by_eight;
        add_to_blocks(squares + 4, open, MATCH_BLOCKS - 4, i / LANES, by_eight.x + by_eight.y);
    }
    for (int i = 0; i < MATCH_SUMS; ++i) sums[i] = sum_lanes(total[i]);
    if (!full) return;
    close_blocks(squares + 4, open, MATCH_BLOCKS - 4, (others + LANES - 1) / LANES);
    const float4 pair = two.lo + two.hi;
    squares[0] = sum_lanes(one), squares[1] = pair.x + pair.y + pair.z + pair.w;
    squares[2] = four.x + four.y + four.z + four.w, squares[3] = eight.x + eight.y;
}
