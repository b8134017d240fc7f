// Match of two scans by point-to-line ICP: iterations, score and numbers of the result. Bodies of sum_pairs and agreement,
// scalar or in lanes, stand before this file in a program.
// requires: icp_step

// The MATCH_RESULT numbers of a result: pose (3), score, iterations, whether the last step was below ten tolerances, information (6),
// and its part that is due to errors of the lines (6), pairs, sum of weights, weighted sum of squared errors, points
// that the other scan should see, points through which it saw, points that it did not see, and for blocks of 1, 2, 4 to
// 128 successive points the sum of squares of the blocks' sums of weighted errors (8), 0 with thin; the last step (3).

// Weight in the score of a point that the other scan did not see; a point that disagrees has weight 1.
#define UNSEEN ((real)0.13)

// A match so far: pose (x, y, theta), last step, sums of the last iteration over pairs and blocks.
typedef struct {
    real4 pose, moved;
    real sums[MATCH_SUMS], squares[MATCH_BLOCKS];
    int iteration, calm;
} Match;

// Return the rules of a level.
MatchRules rules_of(global const real *rules, const int level) {
    global const real *numbers = rules + MATCH_RULES * level;
    MatchRules of;
    of.iterations = (int)numbers[0], of.stride = (int)numbers[1], of.skip = (int)numbers[2];
    of.score_stride = (int)numbers[3], of.thin = (int)numbers[4], of.one_way = (int)numbers[5];
    of.capture = numbers[6], of.least_capture = numbers[7], of.scale = numbers[8], of.least_scale = numbers[9];
    of.shrink = numbers[10], of.gap = numbers[11], of.near = numbers[12], of.tolerance = numbers[13];
    return of;
}

// Return a step of at most half the first capture radius and 0.3 rad, with the length that it had in w.
real4 limited_step(const real4 step, const real capture) {
    const real length = sqrt(step.x * step.x + step.y * step.y), most = (real)0.5 * capture;
    const real share = length > most ? most / length : 1;
    return (real4)(share * step.x, share * step.y, fmax(fmin(step.z, (real)0.3), (real)-0.3), length);
}

// Refine a guess until steps are below the tolerance. Every stride-th point and every skip-th of the reference take part
// until capture radius and scale have shrunk, with thin also afterwards.
Match refine(global const real4 *point, global const real4 *line, const int count, global const real4 *other,
             const int others, const real4 guess, const MatchRules rules, const Team team) {
    Match match;
    real capture = rules.capture, scale = rules.scale;
    int settled = 0;
    match.pose = guess;
    match.moved = (real4)(0);
    match.iteration = match.calm = 0;
    for (int i = 0; i < MATCH_SUMS; ++i) match.sums[i] = 0;
    for (int i = 0; i < MATCH_BLOCKS; ++i) match.squares[i] = 0;
    while (match.iteration < rules.iterations && !settled && count > 0) {
        const int last = capture <= rules.least_capture && scale <= rules.least_scale, full = last && !rules.thin;
        const real4 pose = (real4)(match.pose.xy, cos(match.pose.z), sin(match.pose.z));
        sum_pairs(point, line, count, other, others, full ? 1 : rules.stride, full ? 1 : rules.skip, pose, capture, scale,
                  last, full, match.sums, match.squares, team);
        ++match.iteration;
        const real4 solved = solve(match.sums);
        if (solved.w == 0) break;
        const real4 step = limited_step(solved, rules.capture);
        match.moved = step;
        match.pose.xyz += step.xyz;
        const real change = fmax(step.w, fabs(step.z));
        settled = last && change < rules.tolerance;
        match.calm = last && change < 10 * rules.tolerance;
        const int quiet = step.w < (real)0.1 * scale && fabs(step.z) < (real)0.03 * scale;
        const real factor = quiet && !last ? rules.shrink * rules.shrink : rules.shrink;
        capture = fmax(capture * factor, rules.least_capture);
        scale = fmax(scale * factor, rules.least_scale);
    }
    return match;
}

// Return how well two scans agree at a pose (x, y, theta), as the sum of both directions, or of one with one_way.
real4 mutual_agreement(global const real4 *point, global const real4 *line, const int first, const int count,
                       const int second, const int others, const real4 pose, const MatchRules rules,
                       const Team team) {
    if (count == 0 || others == 0) return (real4)(0);
    const int skip = rules.thin ? rules.skip : 1;
    const real c = cos(pose.z), s = sin(pose.z);
    const real4 forward = (real4)(pose.x, pose.y, c, s);
    const real4 inverse = (real4)(-c * pose.x - s * pose.y, s * pose.x - c * pose.y, c, -s);
    const real4 there = agreement(point + first, line + first, count, point + second, others, rules.score_stride, skip,
                                  forward, rules.near, rules.gap, team);
    if (rules.one_way) return there;
    return there + agreement(point + second, line + second, others, point + first, count, rules.score_stride, skip,
                             inverse, rules.near, rules.gap, team);
}

// Match a pair (reference, second scan, level of its rules) from a guess, write the result, and return the pose.
real4 match_pair(global const real4 *point, global const int *start, global const real4 *line, global const int *pair,
                const real4 guess, global const real *rules, global real *out, const Team team) {
    const int first = start[pair[0]], count = start[pair[0] + 1] - first;
    const int second = start[pair[1]], others = start[pair[1] + 1] - second;
    const MatchRules of = rules_of(rules, pair[2]);
    const Match match = refine(point + first, line + first, count, point + second, others, guess, of, team);
    const real4 both = mutual_agreement(point, line, first, count, second, others, match.pose, of, team);
    if (team.member > 0) return match.pose;
    const real all = both.y + both.z + UNSEEN * both.w;
    out[0] = match.pose.x, out[1] = match.pose.y, out[2] = match.pose.z;
    out[3] = all > 0 ? (both.x - (real)0.5 * both.z) / all : 0;
    out[4] = match.iteration, out[5] = match.calm;
    for (int i = 0; i < 6; ++i) {
        out[6 + i] = match.sums[i];
        out[12 + i] = match.sums[9 + i];
    }
    out[18] = match.sums[17], out[19] = match.sums[15], out[20] = match.sums[16];
    out[21] = both.y, out[22] = both.z, out[23] = both.w;
    for (int i = 0; i < MATCH_BLOCKS; ++i) out[24 + i] = match.squares[i];
    out[32] = match.moved.x, out[33] = match.moved.y, out[34] = match.moved.z;
    return match.pose;
}

// Match a pair from a guess, and with two turns again from its result if that is farther from the guess than a distance
// along an axis or a turn; otherwise the second result has 0 iterations.
void match_in_turns(global const real4 *point, global const int *start, global const real4 *line, global const int *pair,
                    const real4 guess, global const real *rules, global real *out, const int turns, const real far,
                    const real far_turn, const Team team) {
    real4 from = guess;
    if (turns > 1 && team.member == 0) out[MATCH_RESULT + 4] = 0;
    for (int turn = 0; turn < turns; ++turn) {
        const real4 pose = match_pair(point, start, line, pair, from, rules, out + MATCH_RESULT * turn, team);
        const real4 off = fabs(pose - from);
        if (!(off.x > far || off.y > far || off.z > far_turn)) return;
        from = pose;
    }
}
