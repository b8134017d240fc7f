// Pairs of point-to-line ICP: nearest points, sums over pairs, and the agreement of two scans; see the reference.
// requires: icp_step

// Rounding errors of bounds are far below this share.
#define ALMOST ((real)0.999)

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
                const int others, const int stride, const int skip, const real4 pose, const real near, const real gap,
                const Team team) {
    const int used = (others + stride - 1) / stride, share = 1 << log_share(used), begin = team.member * share;
    const real scale = near / 3;
    real sum[4] = {0, 0, 0, 0};
    int ahead = others > 0 ? (int)((long)count * begin * stride / others) : 0;
    for (int k = begin; k < begin + share && k < used; ++k) {
        const real2 p = other[stride * k].xy;
        const real2 place = (real2)(pose.z * p.x - pose.w * p.y + pose.x, pose.w * p.x + pose.z * p.y + pose.y);
        ahead = points_before(point, count, 1, bearing_of(place), ahead);
        const int which = nearest_point(point, count, ahead, skip, place, near * near);
        if (which >= 0) {
            const real ratio = (line[which].x * place.x + line[which].y * place.y - line[which].z) / scale;
            sum[0] += 1 / (1 + ratio * ratio);
            sum[1] += 1;
        } else {
            const real4 low = point[ahead > 0 ? ahead - 1 : count - 1], high = point[ahead < count ? ahead : 0];
            const real between = high.z < low.z ? high.z - low.z + FULL_TURN : high.z - low.z;
            const real range = fmin(low.w, high.w);
            if (between <= gap && dot(place, place) < range * range)
                sum[2] += 1;
            else
                sum[3] += 1;
        }
    }
    add_over_team(sum, 4, team);
    return (real4)(sum[0], sum[1], sum[2], sum[3]);
}

// Write the sums over the pairs of a scan's points at a pose (x, y, cos, sin), and the sums of blocks, 0 unless full.
void sum_pairs(global const real4 *point, global const real4 *line, const int count, global const real4 *other,
               const int others, const int stride, const int skip, const real4 pose, const real capture,
               const real scale, const int last, const int full, real *sums, real *squares, const Team team) {
    const int used = (others + stride - 1) / stride, log = log_share(used), begin = team.member << log;
    const int own = max(min(used - begin, 1 << log), 0), levels = min(log + 1, MATCH_BLOCKS);
    real open[MATCH_BLOCKS], whole = 0;
    int ahead = others > 0 ? (int)((long)count * begin * stride / others) : 0;
    for (int i = 0; i < MATCH_SUMS; ++i) sums[i] = 0;
    for (int i = 0; i < MATCH_BLOCKS; ++i) squares[i] = open[i] = 0;
    for (int k = 0; k < own; ++k) {
        const real2 p = other[stride * (begin + k)].xy;
        const real2 arm = (real2)(pose.z * p.x - pose.w * p.y, pose.w * p.x + pose.z * p.y), place = arm + pose.xy;
        ahead = points_before(point, count, 1, bearing_of(place), ahead);
        const int near = nearest_point(point, count, ahead, skip, place, capture * capture);
        real pull = 0;
        if (near >= 0 && line[near].w > 0) pull = add_pairing(sums, line[near], place, arm, scale, last);
        if (full) add_to_blocks(squares, open, levels, k, pull);
        whole += pull;
    }
    add_over_team(sums, MATCH_SUMS, team);
    if (full) {
        close_blocks(squares, open, levels, own);
        add_joint_blocks(squares, log, whole, team);
        add_over_team(squares, MATCH_BLOCKS, team);
    }
}
