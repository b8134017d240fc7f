// Classes of the beams of a scan at one pose: each beam is walked through the map with two companions that start next
// to it and diverge. gpusense.localization.beam_consistency describes the classes. Steps are half a cell. With IN_TEAMS
// the work-items of a group share the steps of a walk, of which each takes some neighbours.
// requires: heading

// Values of unknown cells, and of places off the map, also unknown.
#define UNKNOWN 255
#define OFF 256
// Step of a walk, and farthest start of one, where no map reaches [cells].
#define STEP 0.5
#define AFAR 1e9
#define BEAM_NOTHING 0
#define BEAM_AGREES 1
#define BEAM_SHORT 2
#define BEAM_THROUGH 3
#define BEAM_VANISHED 4

// Work-items that share a walk.
#if SMALL_TEAMS
#define WALKERS 32
#else
#define WALKERS 256
#endif

// A work-item's number among those that share a walk, their number, and memory that they share.
typedef struct {
    int member, members;
#if IN_TEAMS
    local double2 *shared;
#endif
} Walkers;

// Return the least numbers of all members.
double2 least_of_team(const double2 own, const Walkers team) {
#if IN_TEAMS
    local double2 *mine = team.shared + team.member;
    barrier(CLK_LOCAL_MEM_FENCE);
    *mine = own;
    for (int apart = team.members / 2; apart > 0; apart /= 2) {
        barrier(CLK_LOCAL_MEM_FENCE);
        if (team.member < apart) *mine = fmin(*mine, mine[apart]);
    }
    barrier(CLK_LOCAL_MEM_FENCE);
    return team.shared[0];
#else
    return own;
#endif
}

// Return the floor of a coordinate; some drivers call floor as a function.
int floor_of(const double position) {
    const int whole = (int)position;
    return whole - (whole > position);
}

// Return the value of a cell.
int value_at(global const uchar *cells, const int col, const int row, const int rows, const int cols) {
    // As unsigned numbers, negative indices exceed every limit.
    return (uint)col < (uint)cols && (uint)row < (uint)rows ? cells[(long)row * cols + col] : OFF;
}

// Return whether a value marks a wall.
int is_wall(const int value, const int occupied) {
    return value >= occupied && value < UNKNOWN;
}

// Return the distances along a ray to the first wall, and to the first unknown cell before it [cells]; infinite for none.
// A pair of walls that share a corner stops a ray. The steps are those from begin to before end.
double2 walk_ray(const double2 start, const double2 slope, const int begin, const int end, global const uchar *cells,
                 const int rows, const int cols, const int occupied) {
    double2 first = (double2)(INFINITY, INFINITY);
    int col_before = 0, row_before = 0, value_before = OFF;
    if (begin > 0) {
        const double distance = STEP * (begin - 1);
        col_before = floor_of(slope.x * distance + start.x);
        row_before = floor_of(slope.y * distance + start.y);
        value_before = value_at(cells, col_before, row_before, rows, cols);
    }
    for (int k = begin; k < end; ++k) {
        const double distance = STEP * k;
        const int col = floor_of(slope.x * distance + start.x);
        const int row = floor_of(slope.y * distance + start.y);
        // Nothing is new in the same cell.
        if (col == col_before && row == row_before && k > 0) continue;
        const int value = value_at(cells, col, row, rows, cols);
        int stops = is_wall(value, occupied);
        if (col != col_before && row != row_before && value != OFF && value_before != OFF)
            stops |= is_wall(value_at(cells, col_before, row, rows, cols), occupied) &&
                     is_wall(value_at(cells, col, row_before, rows, cols), occupied);
        if (value >= UNKNOWN && isinf(first.y)) first.y = distance;
        if (stops) {
            first.x = distance;
            break;
        }
        col_before = col, row_before = row, value_before = value;
    }
    return first;
}

// Return the distances [m] along a beam (side 0) or its companion on one side (1 or -1), which starts next to it and
// diverges.
double2 walk_beside(const double side, const double direction, const double2 origin, const double2 companion,
                    const int steps, global const uchar *cells, const int rows, const int cols,
                    const double cell, const int occupied, const Walkers team) {
    const double2 along = cos_sin(direction), slope = cos_sin(direction + side * companion.y);
    const double shift = side * companion.x;
    const double x = (origin.x - shift * along.y) / cell, y = (origin.y + shift * along.x) / cell;
    const double2 start = (double2)(fmin(fmax(x, -AFAR), AFAR), fmin(fmax(y, -AFAR), AFAR));
    const int share = (steps + team.members - 1) / team.members, begin = team.member * share;
    const double2 own = walk_ray(start, slope, begin, min(begin + share, steps), cells, rows, cols, occupied);
    double2 first = least_of_team(own, team);
    if (first.y > first.x) first.y = INFINITY;
    return first * cell;
}

// Return where the beams of an estimated pose begin, along the map's axes [m].
double2 origin_of(global const double *estimate, const Frame frame) {
    double x = estimate[0] - frame.origin_x, y = estimate[1] - frame.origin_y;
    if (frame.mount_x != 0 || frame.mount_y != 0) {
        const double2 heading = cos_sin(estimate[2]);
        x += heading.x * frame.mount_x - heading.y * frame.mount_y;
        y += heading.y * frame.mount_x + heading.x * frame.mount_y;
    }
    return (double2)(frame.yaw_cos * x + frame.yaw_sin * y, frame.yaw_cos * y - frame.yaw_sin * x);
}

// Return the largest deviation of an estimated position over directions [m], and the heading's deviation [rad]. Both
// are infinite if the covariance is not finite; a variance is negative by rounding.
double2 deviations_of(global const double *estimate) {
    const double xx = fmax(estimate[3], 0.0), xy = estimate[4], yy = fmax(estimate[6], 0.0), tt = fmax(estimate[8], 0.0);
    const double all = estimate[3] + estimate[4] + estimate[5] + estimate[6] + estimate[7] + estimate[8];
    if (!(all - all == 0)) return (double2)(INFINITY, INFINITY);
    const double half_apart = (xx - yy) / 2;
    return (double2)(sqrt((xx + yy) / 2 + sqrt(half_apart * half_apart + xy * xy)), sqrt(tt));
}

// Judge the beams of an estimated pose: a work-item, or with IN_TEAMS a team of them, takes a beam. The scan has their
// directions relative to the heading, in the map's frame, then their readings (NaN for no beam). The result has their
// classes, then the distances to the first wall on the beam itself.
kernel void judge_beams(ARGUMENTS) {
#if IN_TEAMS
    local double2 shared[WALKERS];
    const Walkers team = {get_local_id(0), WALKERS, shared};
#else
    const Walkers team = {0, 1};
#endif
    const int b = get_global_id(0) / team.members;
    if (b >= beams) return;
    if (isnan(scan[beams + b])) {
        judged[b] = BEAM_NOTHING;
        judged[beams + b] = INFINITY;
        return;
    }
    const double2 origin = origin_of(estimate, frame), deviation = deviations_of(estimate);
    const double near = fmin(deviation.x, rules.most_beside);
    const double2 companion = (double2)(fmin(fmax(rules.beside, deviation.x), rules.most_beside),
                                        fmin(fmax(rules.apart, deviation.y), rules.most_apart) + rules.cone);
    const double direction = scan[b] + estimate[2], cell = frame.resolution;
    const int returned = scan[beams + b] < rules.range_max, occupied = rules.occupied;
    const double reading = returned ? scan[beams + b] : rules.range_max;
    const double tolerance = fmax(fmax(rules.least, near), rules.part * reading);
    const double before = reading - tolerance, after = reading + tolerance;
    const int within = returned && reading <= rules.limit, steps = (int)(fmin(after, rules.limit) / (cell * STEP)) + 1;
    // A ray gives no evidence beyond the first unknown cell.
    const double end = returned ? before : reading;
    const double2 own = walk_beside(0, direction, origin, companion, steps, cells, rows, cols, cell, occupied, team);
    int kind = BEAM_NOTHING;
    if (within && own.x >= before && own.x <= after && own.y >= fmin(own.x, end)) {
        kind = BEAM_AGREES;
    } else {
        const double2 left =
            walk_beside(1, direction, origin, companion, steps, cells, rows, cols, cell, occupied, team);
        const double2 right =
            walk_beside(-1, direction, origin, companion, steps, cells, rows, cols, cell, occupied, team);
        const double nearest = fmin(own.x, fmin(left.x, right.x)), farthest = fmax(own.x, fmax(left.x, right.x));
        const int seen = own.y >= fmin(own.x, end) && left.y >= fmin(left.x, end) && right.y >= fmin(right.x, end);
        if (seen && within && isinf(nearest)) kind = BEAM_SHORT;
        if (seen && !returned && !isinf(farthest)) kind = BEAM_VANISHED;
        if (seen && returned && farthest < before) kind = BEAM_THROUGH;
        if (seen && within && nearest <= after && farthest >= before && !isinf(farthest)) kind = BEAM_AGREES;
    }
    judged[b] = kind;
    judged[beams + b] = own.x;
}
