"""Steps of point-to-line ICP that scalar bodies and bodies in lanes share."""

import warp as wp

from .flags import IN_TEAMS, SMALL_TEAMS
from .prelude import on_gpu
from .types import real, vec2, vec4

# Sums over pairs: information (6), gradient (3), errors of the lines (6), weights, squared errors, pairs.
MATCH_SUMS = 18
# Blocks have 1, 2, 4 to 2^(MATCH_BLOCKS - 1) points.
MATCH_BLOCKS = 8
# Numbers that are summed at once: in float64 they take 18 of the 32 KiB that every device shares at least.
AT_ONCE = 9
# Bodies of functions of a team. Work-items of processors share nothing: the first member takes all points.
_ADD_OVER_TEAM = """
#if defined(__CUDA_ARCH__)
__shared__ {real} shared[{some} * {team}];
{real} *mine = shared + threadIdx.x;
wp::vec_t<{sums}, {real}> total = numbers;
for (int first = 0; first < {sums}; first += {some}) {{
    __syncthreads();
    for (int i = 0; i < {some}; ++i) mine[{team} * i] = total.c[first + i];
    for (int apart = {team} / 2; apart > 0; apart /= 2) {{
        __syncthreads();
        if (threadIdx.x >= apart) continue;
        // All loads come first, so that none waits for a store.
        {real} part[{some}];
        for (int i = 0; i < {some}; ++i) part[i] = mine[{team} * i + apart];
        for (int i = 0; i < {some}; ++i) mine[{team} * i] = total.c[first + i] += part[i];
    }}
    __syncthreads();
    for (int i = 0; i < {some}; ++i) total.c[first + i] = shared[{team} * i];
}}
return total;
#else
return numbers;
#endif
"""
_ADD_JOINT_BLOCKS = """
wp::vec_t<{blocks}, {real}> blocks = before;
#if defined(__CUDA_ARCH__)
__shared__ {real} shared[{team}];
__syncthreads();
shared[threadIdx.x] = sum;
__syncthreads();
for (int l = log + 1; l < {levels}; ++l) {{
    const int members = 1 << (l - log), member = threadIdx.x;
    if (member % members != 0) continue;
    {real} total = 0;
    for (int k = member; k < member + members && k < {team}; ++k) total += shared[k];
    blocks.c[l] += total * total;
}}
#endif
return blocks;
"""
# With IN_TEAMS the work-items of a group share the points of a match, each with the same pose and sums.
TEAM = 1


if IN_TEAMS:
    TEAM = 32 if SMALL_TEAMS else 256
Sums = wp.types.vector(length=MATCH_SUMS, dtype=real)
# Squares, and sums of blocks that wait for the second half of their pair.
Blocks = wp.types.vector(length=2 * MATCH_BLOCKS, dtype=real)
ZERO, ONE, THREE, FOUR = real(0.0), real(1.0), real(3.0), real(4.0)
FULL_TURN = real(6.283185307179586)
DAMPING, LEAST_DAMPING, DAMPED_TURN = real(1e-5), real(1e-9), real(1.00001)


@wp.func
def log_share(count: wp.int32):
    """Return log2 of the points of a member, enough for all members to cover count."""
    members = int(1)
    log = int(MATCH_BLOCKS - 1)
    if IN_TEAMS and on_gpu():
        members = TEAM
        log = 0
    while (members << log) < count:
        log += 1
    return log


@wp.func
def bearing_of(place: vec2):
    """Return the bearing of a place in [0, 2 pi)."""
    bearing = wp.atan2(place.y, place.x)
    if bearing < ZERO:
        bearing += FULL_TURN
    return bearing


@wp.func
def points_before(point: wp.array(dtype=vec4), first: wp.int32, count: wp.int32, bearing: real, guess: wp.int32):
    """Return the number of points of a scan with a smaller bearing."""
    i = int(guess)
    if FOUR * bearing < FULL_TURN and 4 * guess > 3 * count:
        i = 0
    elif FOUR * bearing > THREE * FULL_TURN and 4 * guess < count:
        i = count
    while i < count and point[first + wp.min(i, count - 1)].z < bearing:
        i += 1
    while i > 0 and point[first + wp.max(i - 1, 0)].z >= bearing:
        i -= 1
    return i


@wp.func
def solve(sums: Sums):
    """Solve the damped normal equations by Cholesky's factors: step in x, y and theta, and whether there is one."""
    damping = DAMPING * (sums[0] + sums[3]) + LEAST_DAMPING
    xx = sums[0] + damping
    yy = sums[3] + damping
    tt = sums[5] * DAMPED_TURN + LEAST_DAMPING
    a = wp.sqrt(xx)
    b = sums[1] / a
    c = sums[2] / a
    second = yy - b * b
    if not second > ZERO:
        return vec4()
    d = wp.sqrt(second)
    e = (sums[4] - b * c) / d
    third = tt - c * c - e * e
    if not third > ZERO:
        return vec4()
    f = wp.sqrt(third)
    u = sums[6] / a
    v = (sums[7] - b * u) / d
    w = (sums[8] - c * u - e * v) / f
    theta = w / f
    y = (v - e * theta) / d
    x = (u - b * y - c * theta) / a
    return vec4(x, y, theta, ONE)


@wp.func
def add_to_blocks(before: Blocks, levels: wp.int32, i: wp.int32, number: real):
    """Return blocks with the number of the i-th point: element l is the sum of squared sums of blocks of 2^l points."""
    blocks = before
    total = number
    waits = int(0)
    for level in range(MATCH_BLOCKS):
        if waits == 0 and level < levels:
            blocks[level] += total * total
            if ((i >> level) & 1) == 0:
                blocks[MATCH_BLOCKS + level] = total
                waits = 1
            else:
                total += blocks[MATCH_BLOCKS + level]
    return blocks


@wp.func
def close_blocks(before: Blocks, levels: wp.int32, count: wp.int32):
    """Return blocks including the last, shorter ones."""
    blocks = before
    rest = real(0.0)
    for level in range(MATCH_BLOCKS - 1):
        if level + 1 < levels:
            if ((count >> level) & 1) == 1:
                rest += blocks[MATCH_BLOCKS + level]
            blocks[level + 1] += rest * rest
    return blocks


numbers = {
    "real": "double" if real == wp.float64 else "float", "sums": MATCH_SUMS, "blocks": 2 * MATCH_BLOCKS,
    "levels": MATCH_BLOCKS, "team": TEAM, "some": AT_ONCE,
}  # fmt: skip


# Return the sums of numbers over the team.
@wp.func_native(_ADD_OVER_TEAM.format(**numbers))
def add_over_team(numbers: Sums) -> Sums: ...


# Return blocks with those of several members, given the sum of this member's 2^log points.
@wp.func_native(_ADD_JOINT_BLOCKS.format(**numbers))
def add_joint_blocks(before: Blocks, log: wp.int32, sum: real) -> Blocks: ...
