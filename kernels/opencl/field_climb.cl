// Damped Gauss-Newton (Levenberg) from poses to maxima of an interpolated likelihood field. Damping and the stopping rule are
// the same in all directions, so that ends turn with the map.
// requires: field_gradient placement

// Numbers of a climb: the best pose (3), its log-likelihood, gradient (3) and information (6), the pose to start from (2),
// damping, steps, whether the last step was small, and whether the climb has ended.
#define VALUE 3
#define SLOPE 4
#define MATRIX 7
#define START 13
#define DAMPING 15
#define STEPS 16
#define CALM 17
#define ENDED 18
// Longest and largest step [m, rad], and the farthest that a climb leads from its start [m].
#define LONGEST 0.5
#define LARGEST 0.3
#define FARTHEST_CLIMB 5.0
// Damping of a direction without information, relative to the largest information.
#define LEAST 1e-6

// Solve for the step that damping allows, of at most the longest length and turn.
void damped_step(const double *climb, double *step) {
    const double *i = climb + MATRIX, *g = climb + SLOPE;
    const double mean = 0.5 * (i[0] + i[3]), most = mean > i[5] ? mean : i[5];
    const double damping = climb[DAMPING], least = LEAST * (1 + most);
    const double a = i[0] + damping * mean + least, d = i[3] + damping * mean + least, f = i[5] + damping * i[5] + least;
    const double b = i[1], c = i[2], e = i[4];
    const double xx = d * f - e * e, xy = c * e - b * f, xt = b * e - c * d;
    const double determinant = a * xx + b * xy + c * xt;
    step[0] = (xx * g[0] + xy * g[1] + xt * g[2]) / determinant;
    step[1] = (xy * g[0] + (a * f - c * c) * g[1] + (b * c - a * e) * g[2]) / determinant;
    step[2] = (xt * g[0] + (b * c - a * e) * g[1] + (a * d - b * b) * g[2]) / determinant;
    const double length = sqrt(step[0] * step[0] + step[1] * step[1]) / LONGEST, turn = fabs(step[2]) / LARGEST;
    const double over = length > turn ? length : turn;
    for (int k = 0; k < 3; ++k) step[k] = over > 1 ? step[k] / over : step[k];
}

// Judge the pose that was tried, and replace it by the next one. Numbers are in the grid's frame: log p, gradient (3), and
// the upper half of the information by rows.
void climb_step(double *at, double *tried, const double *numbers, const int most, const double small, const double yaw_cos,
                const double yaw_sin) {
    const double off_x = tried[0] - at[0], off_y = tried[1] - at[1], turn = fabs(tried[2] - at[2]);
    const double far_x = tried[0] - at[START], far_y = tried[1] - at[START + 1];
    const bool first = at[STEPS] < 0, within = far_x * far_x + far_y * far_y <= FARTHEST_CLIMB * FARTHEST_CLIMB;
    const bool better = first || (numbers[0] >= at[VALUE] && within);
    if (better) {
        const double c = yaw_cos, s = yaw_sin, x = numbers[1], y = numbers[2];
        const double xx = numbers[4], xy = numbers[5], xt = numbers[6], yy = numbers[7], yt = numbers[8];
        for (int k = 0; k < 3; ++k) at[k] = tried[k];
        at[VALUE] = numbers[0];
        at[SLOPE] = c * x - s * y;
        at[SLOPE + 1] = s * x + c * y;
        at[SLOPE + 2] = numbers[3];
        at[MATRIX] = c * c * xx - 2 * c * s * xy + s * s * yy;
        at[MATRIX + 1] = c * s * (xx - yy) + (c * c - s * s) * xy;
        at[MATRIX + 2] = c * xt - s * yt;
        at[MATRIX + 3] = s * s * xx + 2 * c * s * xy + c * c * yy;
        at[MATRIX + 4] = s * xt + c * yt;
        at[MATRIX + 5] = numbers[9];
    }
    if (!first) {
        const double damping = better ? at[DAMPING] / 5 : at[DAMPING] * 8;
        at[DAMPING] = damping < 1e-6 ? 1e-6 : damping > 1e6 ? 1e6 : damping;
        at[CALM] = off_x * off_x + off_y * off_y < small * small && turn < small;
    }
    at[STEPS] += 1;
    at[ENDED] = at[CALM] != 0 || at[STEPS] >= most;
    double step[3] = {0, 0, 0};
    if (at[ENDED] == 0) damped_step(at, step);
    for (int k = 0; k < 3; ++k) tried[k] = at[k] + step[k];
}

// With IN_TEAMS the work-items of a group share the readings of a scan, each with the same climb.
#if IN_TEAMS
#if SMALL_TEAMS
#define TEAM 32
#else
#define TEAM 256
#endif

// Replace numbers by their sums over the team.
void add_over_members(double *numbers, local double *shared) {
    local double *mine = shared + get_local_id(0);
    // All members have written the last pose before one writes the next.
    barrier(CLK_LOCAL_MEM_FENCE | CLK_GLOBAL_MEM_FENCE);
    for (int i = 0; i < CLIMB_SUMS; ++i) mine[TEAM * i] = numbers[i];
    for (int apart = TEAM / 2; apart > 0; apart /= 2) {
        barrier(CLK_LOCAL_MEM_FENCE);
        if (get_local_id(0) >= apart) continue;
        for (int i = 0; i < CLIMB_SUMS; ++i) mine[TEAM * i] += mine[TEAM * i + apart];
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    for (int i = 0; i < CLIMB_SUMS; ++i) numbers[i] = shared[TEAM * i];
}
#endif

// Climb from placed poses, one a scan, and write the ends. One work-item, or with IN_TEAMS a team of them, takes a scan.
kernel void climb_field(ARGUMENTS) {
#if IN_TEAMS
    local double shared[CLIMB_SUMS * TEAM];
    const int n = get_group_id(0), member = get_local_id(0), members = TEAM;
#else
    const int n = get_global_id(0), member = 0, members = 1;
#endif
    if (n >= scans) return;
#if SCANS
    const int first = start[n], size = start[n + 1];
    const real constant_term = constant_terms[n];
#else
    const int first = 0, size = readings;
    const real constant_term = score.constant_term;
#endif
    double at[CLIMB], tried[3];
    for (int k = 0; k < CLIMB; ++k) at[k] = climb[CLIMB * n + k];
    for (int k = 0; k < 3; ++k) tried[k] = poses[3 * n + k];
    while (at[ENDED] == 0) {
#if TWO_PART_POINTS
        const real4 low = pose_low[n];
#else
        const real4 low = (real4)(0);
#endif
        real sums[CLIMB_SUMS - 1];
        for (int i = 0; i < CLIMB_SUMS - 1; ++i) sums[i] = 0;
        // The first member has the constant term.
        const real2 own = add_readings((real2)(member > 0 ? 0 : constant_term, 0), sums, table, pose_cell[n], pose[n], low,
                                       point, point_low, terms, first + member, size, members, window, guard,
                                       (real2)(mount_x, mount_y), resolution);
        double numbers[CLIMB_SUMS];
        numbers[0] = scaled_sum(own, score.temperature);
        for (int i = 1; i < CLIMB_SUMS; ++i) numbers[i] = score.temperature * sums[i - 1];
#if IN_TEAMS
        add_over_members(numbers, shared);
#endif
        climb_step(at, tried, numbers, most, small, yaw_cos, yaw_sin);
        // All members write the same numbers.
        for (int k = 0; k < 3; ++k) poses[3 * n + k] = tried[k];
        place_pose(n, poses, pose_cell, pose, pose_low, pose_status, frame, window);
    }
    if (member > 0) return;
    for (int k = 0; k < CLIMB; ++k) climb[CLIMB * n + k] = at[k];
}
