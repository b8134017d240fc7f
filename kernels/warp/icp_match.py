"""Match of two scans by point-to-line ICP: iterations, score and numbers of the result."""

import warp as wp

from gpusense.interface.constants import MATCH_RESULT, MATCH_RULES

from .icp_pairs import agreement, sum_pairs
from .icp_step import MATCH_BLOCKS, Blocks, Sums, solve
from .types import MatchRules, real, vec4

# The MATCH_RESULT numbers of a result: pose (3), score, iterations, whether the last step was below ten tolerances,
# information (6), and its part that is due to errors of the lines (6), pairs, sum of weights, weighted sum of squared
# errors, points that the other scan should see, points through which it saw, points that it did not see, and for
# blocks of 1, 2, 4 to 128 successive points the sum of squares of the blocks' sums of weighted errors (8), 0 with
# thin; the last step (3).
ZERO, ONE, HALF = real(0.0), real(1.0), real(0.5)
TENTH, TEN, LARGEST_TURN, QUIET_TURN = real(0.1), real(10.0), real(0.3), real(0.03)
# Weight in the score of a point that the other scan did not see; a point that disagrees has weight 1.
UNSEEN = real(0.13)


@wp.func
def rules_of(rules: wp.array(dtype=real), level: wp.int32):
    """Return the rules of a level."""
    first = level * MATCH_RULES
    of = MatchRules()
    of.iterations = int(rules[first])
    of.stride = int(rules[first + 1])
    of.skip = int(rules[first + 2])
    of.score_stride = int(rules[first + 3])
    of.thin = int(rules[first + 4])
    of.one_way = int(rules[first + 5])
    of.capture = rules[first + 6]
    of.least_capture = rules[first + 7]
    of.scale = rules[first + 8]
    of.least_scale = rules[first + 9]
    of.shrink = rules[first + 10]
    of.gap = rules[first + 11]
    of.near = rules[first + 12]
    of.tolerance = rules[first + 13]
    return of


@wp.func
def limited_step(step: vec4, capture: real):
    """Return a step of at most half the first capture radius and 0.3 rad, with the length that it had in w."""
    length = wp.sqrt(step.x * step.x + step.y * step.y)
    most = HALF * capture
    share = ONE
    if length > most:
        share = most / length
    turn = wp.max(wp.min(step.z, LARGEST_TURN), -LARGEST_TURN)
    return vec4(share * step.x, share * step.y, turn, length)


@wp.func
def refine(
    point: wp.array(dtype=vec4), line: wp.array(dtype=vec4), first: wp.int32, count: wp.int32, second: wp.int32,
    others: wp.int32, guess: vec4, rules: MatchRules, member: wp.int32,
):  # fmt: skip
    """Refine a guess until steps are below the tolerance; return it with last step, sums and iterations."""
    pose = guess
    moved = vec4()
    sums = Sums()
    blocks = Blocks()
    capture = rules.capture
    scale = rules.scale
    iteration = int(0)
    settled = int(0)
    calm = int(0)
    running = int(1)
    while running == 1 and iteration < rules.iterations and settled == 0 and count > 0:
        last = capture <= rules.least_capture and scale <= rules.least_scale
        full = last and rules.thin == 0
        stride = int(rules.stride)
        skip = int(rules.skip)
        if full:
            stride = 1
            skip = 1
        at = vec4(pose.x, pose.y, wp.cos(pose.z), wp.sin(pose.z))
        sums, blocks = sum_pairs(
            point, line, first, count, second, others, stride, skip, at, capture, scale, last, full, member
        )
        iteration += 1
        solved = solve(sums)
        if solved.w == ZERO:
            running = 0
        else:
            step = limited_step(solved, rules.capture)
            turned = wp.abs(step.z)
            moved = step
            pose = vec4(pose.x + step.x, pose.y + step.y, pose.z + step.z, ZERO)
            change = wp.max(step.w, turned)
            settled = int(last and change < rules.tolerance)
            calm = int(last and change < TEN * rules.tolerance)
            factor = rules.shrink
            if step.w < TENTH * scale and turned < QUIET_TURN * scale and not last:
                factor = rules.shrink * rules.shrink
            capture = wp.max(capture * factor, rules.least_capture)
            scale = wp.max(scale * factor, rules.least_scale)
    return pose, moved, sums, blocks, iteration, calm


@wp.func
def mutual_agreement(
    point: wp.array(dtype=vec4), line: wp.array(dtype=vec4), first: wp.int32, count: wp.int32, second: wp.int32,
    others: wp.int32, pose: vec4, rules: MatchRules, member: wp.int32,
):  # fmt: skip
    """Return how well two scans agree at a pose (x, y, theta); one_way looks in one direction only."""
    both = vec4()
    if count > 0 and others > 0:
        c = wp.cos(pose.z)
        s = wp.sin(pose.z)
        forward = vec4(pose.x, pose.y, c, s)
        inverse = vec4(-c * pose.x - s * pose.y, s * pose.x - c * pose.y, c, -s)
        stride = rules.score_stride
        skip = int(1)
        if rules.thin == 1:
            skip = rules.skip
        both = agreement(
            point, line, first, count, second, others, stride, skip, forward, rules.near, rules.gap, member
        )
        if rules.one_way == 0:
            both += agreement(
                point, line, second, others, first, count, stride, skip, inverse, rules.near, rules.gap, member
            )
    return both


@wp.func
def match_pair(
    point: wp.array(dtype=vec4), start: wp.array(dtype=wp.int32), line: wp.array(dtype=vec4),
    pair: wp.array(dtype=wp.int32), which: wp.int32, guess: vec4, rules: wp.array(dtype=real),
    result: wp.array(dtype=real), out: wp.int32, member: wp.int32,
):  # fmt: skip
    """Match pair number which from a guess, write the result from out on, and return the pose."""
    first = start[pair[which]]
    count = start[pair[which] + 1] - first
    second = start[pair[which + 1]]
    others = start[pair[which + 1] + 1] - second
    of = rules_of(rules, pair[which + 2])
    pose, moved, sums, blocks, iteration, calm = refine(point, line, first, count, second, others, guess, of, member)
    both = mutual_agreement(point, line, first, count, second, others, pose, of, member)
    if member > 0:
        return pose
    everything = both.y + both.z + UNSEEN * both.w
    score = real(0.0)
    if everything > ZERO:
        score = (both.x - HALF * both.z) / everything
    result[out] = pose.x
    result[out + 1] = pose.y
    result[out + 2] = pose.z
    result[out + 3] = score
    result[out + 4] = real(iteration)
    result[out + 5] = real(calm)
    for i in range(6):
        result[out + 6 + i] = sums[i]
        result[out + 12 + i] = sums[9 + i]
    result[out + 18] = sums[17]
    result[out + 19] = sums[15]
    result[out + 20] = sums[16]
    result[out + 21] = both.y
    result[out + 22] = both.z
    result[out + 23] = both.w
    for i in range(MATCH_BLOCKS):
        result[out + 24 + i] = blocks[i]
    result[out + 32] = moved.x
    result[out + 33] = moved.y
    result[out + 34] = moved.z
    return pose


@wp.func
def match_in_turns(
    point: wp.array(dtype=vec4), start: wp.array(dtype=wp.int32), line: wp.array(dtype=vec4),
    pair: wp.array(dtype=wp.int32), which: wp.int32, guess: vec4, rules: wp.array(dtype=real),
    result: wp.array(dtype=real), out: wp.int32, turns: wp.int32, far: real, far_turn: real, member: wp.int32,
):  # fmt: skip
    """Match a pair from a guess, and with two turns again from a result that is far from the guess."""
    start_pose = guess
    turn = int(0)
    if turns > 1 and member == 0:
        result[out + MATCH_RESULT + 4] = ZERO
    while turn < turns:
        pose = match_pair(point, start, line, pair, which, start_pose, rules, result, out + MATCH_RESULT * turn, member)
        x = wp.abs(pose.x - start_pose.x)
        y = wp.abs(pose.y - start_pose.y)
        turned = wp.abs(pose.z - start_pose.z)
        turn += 1
        if not (x > far or y > far or turned > far_turn):
            turn = turns
        start_pose = pose
