// Scan matching by point-to-line ICP. The nearest point is exact: the points of a scan are sorted by bearing, and a
// search outwards from the bearing of a place ends where no point farther in bearing can be nearer. Lines: see
// lines.cl, and Censi (2008), "An ICP variant using a point-to-line metric". Weights: Cauchy's while the scale shrinks,
// then Geman and McClure's, (1 / (1 + (e / c)^2))^2.
// requires: icp_step

// Numbers of a result: pose (3), score, iterations, whether the last step was below ten tolerances, information (6),
// and its part that is due to errors of the lines (6), pairs, sum of weights, weighted sum of squared errors, points
// that the other scan should see, points through which it saw, points that it did not see, and for blocks of 1, 2, 4 to
// 128 successive points the sum of squares of the blocks' sums of weighted errors (8), 0 with thin; the last step (3).
#define MATCH_RESULT 35
// Rounding errors of bounds are far below this share.
#define ALMOST ((real)0.999)
// Weight in the score of a point that the other scan did not see; a point that disagrees has weight 1.
#define UNSEEN ((real)0.13)

// Return the nearest of every skip-th point of a scan that is nearer than the square root of squared, -1 without one;
// ahead points have a smaller bearing than the place.
int nearest_point(global const real4 *point, const int count, const int ahead, const int skip, const real2 place,
                  const real squared) {
    const int kept = (count + skip - 1) / skip, before = (ahead + skip - 1) / skip;
    const real length = dot(place, place);
    real best = squared;
    int which = -1;
    for (int direction = 1; direction >= -1; direction -= 2) {
        int i = direction > 0 ? before : before - 1;
        for (int k = 0; k < kept; ++k) {
            i = i >= kept ? i - kept : i < 0 ? i + kept : i;
            const real2 p = point[skip * i].xy, d = p - place;
            const real distance = d.x * d.x + d.y * d.y;
            if (distance < best) {
                best = distance;
                which = skip * i;
            } else {
                const real cross = place.x * p.y - place.y * p.x;
                const int beside = place.x * p.x + place.y * p.y > 0;
                if (beside ? ALMOST * cross * cross > best * (p.x * p.x + p.y * p.y) : ALMOST * length > best) break;
            }
            i += direction;
        }
    }
    return which;
}

// Add a pair of a line and a place, and return its weighted error; arm is the place relative to the second scan's
// origin.
real add_pairing(real *sums, const real4 line, const real2 place, const real2 arm, const real scale, const int last) {
    const real error = line.x * place.x + line.y * place.y - line.z;
    const real ratio = error / scale;
    real weight = 1 / (1 + ratio * ratio);
    if (last) weight *= weight;
    const real turn = line.y * arm.x - line.x * arm.y, along = line.x * arm.x + line.y * arm.y;
    const real doubt = weight * line.w;
    sums[0] += weight * line.x * line.x;
    sums[1] += weight * line.x * line.y;
    sums[2] += weight * line.x * turn;
    sums[3] += weight * line.y * line.y;
    sums[4] += weight * line.y * turn;
    sums[5] += weight * turn * turn;
    sums[6] -= weight * line.x * error;
    sums[7] -= weight * line.y * error;
    sums[8] -= weight * turn * error;
    sums[9] += doubt * line.y * line.y;
    sums[10] -= doubt * line.x * line.y;
    sums[11] -= doubt * line.y * along;
    sums[12] += doubt * line.x * line.x;
    sums[13] += doubt * line.x * along;
    sums[14] += doubt * along * along;
    sums[15] += weight;
    sums[16] += weight * error * error;
    sums[17] += 1;
    return weight * error;
}

// Return how well every stride-th point of one scan agrees with every skip-th point of another scan: sum of agreements,
// points that the other scan should see, points through which it saw, and points that it did not see. pose is (x, y,
// cos, sin).
real4 agreement(global const real4 *point, global const real4 *line, const int count, global const real4 *other,
                const int others, const int stride, const int skip, const real4 pose, const real near, const real gap) {
    const real scale = near / 3;
    real4 sum = (real4)(0);
    int ahead = 0;
    for (int i = 0; i < others; i += stride) {
        const real2 p = other[i].xy;
        const real2 place = (real2)(pose.z * p.x - pose.w * p.y + pose.x, pose.w * p.x + pose.z * p.y + pose.y);
        ahead = points_before(point, count, 1, bearing_of(place), ahead);
        const int which = nearest_point(point, count, ahead, skip, place, near * near);
        if (which >= 0) {
            const real ratio = (line[which].x * place.x + line[which].y * place.y - line[which].z) / scale;
            sum.x += 1 / (1 + ratio * ratio);
            sum.y += 1;
        } else {
            const real4 low = point[ahead > 0 ? ahead - 1 : count - 1], high = point[ahead < count ? ahead : 0];
            const real between = high.z < low.z ? high.z - low.z + FULL_TURN : high.z - low.z;
            const real range = fmin(low.w, high.w);
            if (between <= gap && dot(place, place) < range * range)
                sum.z += 1;
            else
                sum.w += 1;
        }
    }
    return sum;
}

// Match scans: one work-item takes a pair (reference, second scan) and a guess (x, y, theta), the pose of the second
// scan in the reference's frame. Every stride-th point and every skip-th of the reference take part until capture
// radius and scale have shrunk, with thin also afterwards. With one_way the reference's points do not count in the score.
kernel void match_scans(ARGUMENTS) {
    const int n = get_global_id(0);
    if (n >= pairs * starts) return;
    const int2 which = pair[n / starts];
    const int first = start[which.x], count = start[which.x + 1] - first;
    const int second = start[which.y], others = start[which.y + 1] - second;
    real4 pose = guess[n];
    real sums[MATCH_SUMS], squares[MATCH_BLOCKS], open[MATCH_BLOCKS];
    real capture = rules.capture, scale = rules.scale, cosine = cos(pose.z), sine = sin(pose.z);
    real4 moved = (real4)(0);
    int iteration = 0, settled = 0, calm = 0, ahead = 0;
    for (int i = 0; i < MATCH_SUMS; ++i) sums[i] = 0;
    for (int i = 0; i < MATCH_BLOCKS; ++i) squares[i] = open[i] = 0;
    while (iteration < rules.iterations && !settled && count > 0) {
        const int last = capture <= rules.least_capture && scale <= rules.least_scale;
        for (int i = 0; i < MATCH_SUMS; ++i) sums[i] = 0;
        for (int i = 0; i < MATCH_BLOCKS; ++i) squares[i] = 0;
        const int full = last && !rules.thin, skip = full ? 1 : rules.skip;
        for (int i = 0; i < others; i += full ? 1 : rules.stride) {
            const real2 p = point[second + i].xy;
            const real2 arm = (real2)(cosine * p.x - sine * p.y, sine * p.x + cosine * p.y), place = arm + pose.xy;
            ahead = points_before(point + first, count, 1, bearing_of(place), ahead);
            const int near = nearest_point(point + first, count, ahead, skip, place, capture * capture);
            real pull = 0;
            if (near >= 0 && line[first + near].w > 0)
                pull = add_pairing(sums, line[first + near], place, arm, scale, last);
            if (full) add_to_blocks(squares, open, MATCH_BLOCKS, i, pull);
        }
        if (full) close_blocks(squares, open, MATCH_BLOCKS, others);
        ++iteration;
        real4 step = solve(sums);
        if (step.w == 0) break;
        const real length = sqrt(step.x * step.x + step.y * step.y), most = (real)0.5 * rules.capture;
        if (length > most) step.xy *= most / length;
        step.z = fmax(fmin(step.z, (real)0.3), (real)-0.3);
        moved = step;
        pose += step;
        cosine = cos(pose.z);
        sine = sin(pose.z);
        const real change = fmax(length, fabs(step.z));
        settled = last && change < rules.tolerance;
        calm = last && change < 10 * rules.tolerance;
        const int quiet = length < (real)0.1 * scale && fabs(step.z) < (real)0.03 * scale;
        const real factor = quiet && !last ? rules.shrink * rules.shrink : rules.shrink;
        capture = fmax(capture * factor, rules.least_capture);
        scale = fmax(scale * factor, rules.least_scale);
    }
    global real *out = result + (long)MATCH_RESULT * n;
    real4 there = (real4)(0), back = (real4)(0);
    if (count > 0 && others > 0) {
        const int skip = rules.thin ? rules.skip : 1;
        const real4 inverse = (real4)(-cosine * pose.x - sine * pose.y, sine * pose.x - cosine * pose.y, cosine, -sine);
        there = agreement(point + first, line + first, count, point + second, others, rules.score_stride, skip,
                          (real4)(pose.x, pose.y, cosine, sine), rules.near, rules.gap);
        if (!rules.one_way)
            back = agreement(point + second, line + second, others, point + first, count, rules.score_stride, skip, inverse,
                             rules.near, rules.gap);
    }
    const real4 both = there + back;
    const real all = both.y + both.z + UNSEEN * both.w;
    out[0] = pose.x, out[1] = pose.y, out[2] = pose.z;
    out[3] = all > 0 ? (both.x - (real)0.5 * both.z) / all : 0;
    out[4] = iteration, out[5] = calm;
    for (int i = 0; i < 6; ++i) {
        out[6 + i] = sums[i];
        out[12 + i] = sums[9 + i];
    }
    out[18] = sums[17], out[19] = sums[15], out[20] = sums[16];
    out[21] = both.y, out[22] = both.z, out[23] = both.w;
    for (int i = 0; i < MATCH_BLOCKS; ++i) out[24 + i] = squares[i];
    out[32] = moved.x, out[33] = moved.y, out[34] = moved.z;
}
