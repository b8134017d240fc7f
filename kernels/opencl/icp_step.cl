// Steps of point-to-line ICP that scalar bodies and bodies in lanes share: places among the bearings of a
// scan, the normal equations, sums of blocks of points, and sums over a team of work-items.
// Blocks: Flyvbjerg and Petersen (1989), "Error estimates on averages of correlated data".

// Sums over pairs: information (6), gradient (3), errors of the lines (6), weights, squared errors, pairs.
#define MATCH_SUMS 18
// Blocks have 1, 2, 4 to 2^(MATCH_BLOCKS - 1) points.
#define MATCH_BLOCKS 8
#define FULL_TURN ((real)6.283185307179586)

// With IN_TEAMS the work-items of a group share the points of a match, each with the same pose and sums.
#if IN_TEAMS
#if SMALL_TEAMS
#define TEAM 32
#else
#define TEAM 256
#endif
// Numbers that are summed at once: in float64 they take 18 of the 32 KiB that every device shares at least.
#define AT_ONCE 9
#else
#define TEAM 1
#endif

// A work-item's number in its team, and memory of the team for AT_ONCE numbers of each.
typedef struct {
    int member;
#if IN_TEAMS
    local real *shared;
#endif
} Team;

// Return log2 of the points of a member, enough for all members to cover count; a team of one takes at least the
// longest block.
int log_share(const int count) {
    int log = TEAM > 1 ? 0 : MATCH_BLOCKS - 1;
    while ((long)TEAM << log < count) ++log;
    return log;
}

// Return the bearing of a place in [0, 2 pi).
real bearing_of(const real2 place) {
    const real bearing = atan2(place.y, place.x);
    return bearing < 0 ? bearing + FULL_TURN : bearing;
}

// Return the number of points among count skip-th points of a scan with a smaller bearing: walk from a guess, which for
// neighbours is the previous number, up to a full turn.
int points_before(global const real4 *point, const int count, const int skip, const real bearing, const int guess) {
    int i = guess;
    if (4 * bearing < FULL_TURN && 4 * guess > 3 * count) i = 0;
    if (4 * bearing > 3 * FULL_TURN && 4 * guess < count) i = count;
    while (i < count && point[skip * i].z < bearing) ++i;
    while (i > 0 && point[skip * (i - 1)].z >= bearing) --i;
    return i;
}

// Solve the damped normal equations by Cholesky's factors: step in x, y and theta, and whether there is one.
real4 solve(const real *sums) {
    const real damping = (real)1e-5 * (sums[0] + sums[3]) + (real)1e-9;
    const real xx = sums[0] + damping, yy = sums[3] + damping, tt = sums[5] * (real)1.00001 + (real)1e-9;
    const real a = sqrt(xx), b = sums[1] / a, c = sums[2] / a;
    const real second = yy - b * b;
    if (!(second > 0)) return (real4)(0);
    const real d = sqrt(second), e = (sums[4] - b * c) / d, third = tt - c * c - e * e;
    if (!(third > 0)) return (real4)(0);
    const real f = sqrt(third);
    const real u = sums[6] / a, v = (sums[7] - b * u) / d, w = (sums[8] - c * u - e * v) / f;
    const real theta = w / f, y = (v - e * theta) / d, x = (u - b * y - c * theta) / a;
    return (real4)(x, y, theta, 1);
}

// Add the number of the i-th point to blocks: squares[l] is the sum of squared sums of blocks of 2^l points, open[l] the
// sum of a block that waits for the second half of its pair.
void add_to_blocks(real *squares, real *open, const int levels, const int i, const real number) {
    real sum = number;
    for (int l = 0; l < levels; ++l) {
        squares[l] += sum * sum;
        if ((i >> l & 1) == 0) {
            open[l] = sum;
            return;
        }
        sum += open[l];
    }
}

// Add the last, shorter blocks.
void close_blocks(real *squares, const real *open, const int levels, const int count) {
    real rest = 0;
    for (int l = 0; l + 1 < levels; ++l) {
        if (count >> l & 1) rest += open[l];
        squares[l + 1] += rest * rest;
    }
}

// Replace numbers by their sums over the team.
void add_over_team(real *numbers, const int count, const Team team) {
#if IN_TEAMS
    local real *mine = team.shared + team.member;
    for (int first = 0; first < count; first += AT_ONCE) {
        const int some = min(count - first, AT_ONCE);
        barrier(CLK_LOCAL_MEM_FENCE);
        for (int i = 0; i < some; ++i) mine[TEAM * i] = numbers[first + i];
        for (int apart = TEAM / 2; apart > 0; apart /= 2) {
            barrier(CLK_LOCAL_MEM_FENCE);
            if (team.member >= apart) continue;
            // All loads come first, so that none waits for a store.
            real part[AT_ONCE];
            for (int i = 0; i < some; ++i) part[i] = mine[TEAM * i + apart];
            for (int i = 0; i < some; ++i) mine[TEAM * i] = numbers[first + i] += part[i];
        }
        barrier(CLK_LOCAL_MEM_FENCE);
        for (int i = 0; i < some; ++i) numbers[first + i] = team.shared[TEAM * i];
    }
#endif
}

// Add the blocks of several members to squares, given the sum of this member's 2^log points.
void add_joint_blocks(real *squares, const int log, const real sum, const Team team) {
#if IN_TEAMS
    barrier(CLK_LOCAL_MEM_FENCE);
    team.shared[team.member] = sum;
    barrier(CLK_LOCAL_MEM_FENCE);
    for (int l = log + 1; l < MATCH_BLOCKS; ++l) {
        const int members = 1 << (l - log);
        if (team.member % members != 0) continue;
        real total = 0;
        for (int k = team.member; k < team.member + members && k < TEAM; ++k) total += team.shared[k];
        squares[l] += total * total;
    }
#endif
}
