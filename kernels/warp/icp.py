"""Scan matching by point-to-line ICP.

The nearest point is exact: the points of a scan are sorted by bearing, and a search outwards from the bearing of a
place ends where no point farther in bearing can be nearer.

Lines: see lines.py, and Censi (2008), "An ICP variant using a point-to-line metric". Weights: Cauchy's while the scale
shrinks, then Geman and McClure's, (1 / (1 + (e / c)^2))^2.
"""

import functools
from types import SimpleNamespace

import warp as wp

from . import icp_step
from .icp_step import MATCH_BLOCKS
from .prelude import kernel, precision, work_item

# Numbers of a result: pose (3), score, iterations, whether the last step was below ten tolerances, information (6), and
# its part that is due to errors of the lines (6), pairs, sum of weights, weighted sum of squared errors, points that
# the other scan should see, points through which it saw, points that it did not see, and for blocks of 1, 2, 4 to 128
# successive points the sum of squares of the blocks' sums of weighted errors (8), 0 with thin; the last step (3).
MATCH_RESULT = wp.constant(35)


@functools.cache
def functions(flags):
    """Make the functions of the file for a set of flags."""
    types = precision(flags)
    real, vec2, vec4 = types.real, types.vec2, types.vec4
    step = icp_step.functions(flags)
    Sums, bearing_of, points_before = step.Sums, step.bearing_of, step.points_before
    ZERO, ONE, THREE = real(0.0), real(1.0), real(3.0)
    FULL_TURN = real(6.283185307179586)
    # Rounding errors of bounds are far below this share.
    ALMOST = real(0.999)

    # Return the nearest of every skip-th point of a scan that is nearer than the square root of squared, -1 without
    # one; ahead points have a smaller bearing than the place.
    @wp.func
    def nearest_point(
        point: wp.array(dtype=vec4), first: wp.int32, count: wp.int32, ahead: wp.int32, skip: wp.int32, place: vec2,
        squared: real,
    ):  # fmt: skip
        kept = (count + skip - 1) // skip
        before = (ahead + skip - 1) // skip
        length = place.x * place.x + place.y * place.y
        best = squared
        which = int(-1)
        for side in range(2):
            direction = int(1)
            i = int(before)
            if side == 1:
                direction = -1
                i = before - 1
            k = int(0)
            while k < kept:
                if i >= kept:
                    i -= kept
                if i < 0:
                    i += kept
                p = point[first + skip * i]
                x = p.x - place.x
                y = p.y - place.y
                distance = x * x + y * y
                if distance < best:
                    best = distance
                    which = skip * i
                else:
                    cross = place.x * p.y - place.y * p.x
                    if place.x * p.x + place.y * p.y > ZERO:
                        if ALMOST * cross * cross > best * (p.x * p.x + p.y * p.y):
                            k = kept
                    elif ALMOST * length > best:
                        k = kept
                i += direction
                k += 1
        return which

    # Return the sums with a pair of a line and a place, and its weighted error; arm is the place relative to the second
    # scan's origin.
    @wp.func
    def add_pairing(before: Sums, line: vec4, place: vec2, arm: vec2, scale: real, last: wp.bool):
        sums = before
        error = line.x * place.x + line.y * place.y - line.z
        ratio = error / scale
        weight = ONE / (ONE + ratio * ratio)
        if last:
            weight *= weight
        turn = line.y * arm.x - line.x * arm.y
        along = line.x * arm.x + line.y * arm.y
        doubt = weight * line.w
        sums[0] += weight * line.x * line.x
        sums[1] += weight * line.x * line.y
        sums[2] += weight * line.x * turn
        sums[3] += weight * line.y * line.y
        sums[4] += weight * line.y * turn
        sums[5] += weight * turn * turn
        sums[6] -= weight * line.x * error
        sums[7] -= weight * line.y * error
        sums[8] -= weight * turn * error
        sums[9] += doubt * line.y * line.y
        sums[10] -= doubt * line.x * line.y
        sums[11] -= doubt * line.y * along
        sums[12] += doubt * line.x * line.x
        sums[13] += doubt * line.x * along
        sums[14] += doubt * along * along
        sums[15] += weight
        sums[16] += weight * error * error
        sums[17] += ONE
        return sums, weight * error

    # Return how well every stride-th point of one scan agrees with every skip-th point of another scan: sum of
    # agreements, points that the other scan should see, points through which it saw, and points that it did not see.
    # pose is (x, y, cos, sin).
    @wp.func
    def agreement(
        point: wp.array(dtype=vec4), line: wp.array(dtype=vec4), first: wp.int32, count: wp.int32, second: wp.int32,
        others: wp.int32, stride: wp.int32, skip: wp.int32, pose: vec4, near: real, gap: real,
    ):  # fmt: skip
        scale = near / THREE
        total = vec4()
        i = int(0)
        ahead = int(0)
        while i < others:
            p = point[second + i]
            x = pose.z * p.x - pose.w * p.y + pose.x
            y = pose.w * p.x + pose.z * p.y + pose.y
            place = vec2(x, y)
            ahead = points_before(point, first, count, bearing_of(place), ahead)
            which = nearest_point(point, first, count, ahead, skip, place, near * near)
            if which >= 0:
                at = line[first + which]
                ratio = (at.x * x + at.y * y - at.z) / scale
                total += vec4(ONE / (ONE + ratio * ratio), ONE, ZERO, ZERO)
            else:
                low = point[first + wp.where(ahead > 0, ahead - 1, count - 1)]
                high = point[first + wp.where(ahead < count, ahead, 0)]
                between = high.z - low.z
                if high.z < low.z:
                    between += FULL_TURN
                smaller = wp.min(low.w, high.w)
                if between <= gap and x * x + y * y < smaller * smaller:
                    total += vec4(ZERO, ZERO, ONE, ZERO)
                else:
                    total += vec4(ZERO, ZERO, ZERO, ONE)
            i += stride
        return total

    return SimpleNamespace(**locals())


@functools.cache
def make(name, flags):
    """Make a kernel of the file for a set of flags."""
    types = precision(flags)
    real, vec2, vec4 = types.real, types.vec2, types.vec4
    made, step = functions(flags), icp_step.functions(flags)
    nearest_point, add_pairing, agreement = made.nearest_point, made.add_pairing, made.agreement
    Sums, bearing_of, points_before, solve = step.Sums, step.bearing_of, step.points_before, step.solve
    Blocks, add_to_blocks, close_blocks = step.Blocks, step.add_to_blocks, step.close_blocks
    ZERO, ONE, HALF = real(0.0), real(1.0), real(0.5)
    TENTH, TEN, LARGEST_TURN, QUIET_TURN = real(0.1), real(10.0), real(0.3), real(0.03)
    # Weight in the score of a point that the other scan did not see; a point that disagrees has weight 1.
    UNSEEN = real(0.13)

    # Match scans: one work-item takes a pair (reference, second scan) and a guess (x, y, theta), the pose of the second
    # scan in the reference's frame. Every stride-th point takes part until capture radius and scale have shrunk, with
    # thin also afterwards. With one_way the reference's points do not count in the score.
    @kernel(flags)
    def match_scans(point, start, line, pair, guess, result, scans, points, pairs, starts, rules):
        n = work_item(wp.tid())
        if n >= pairs * starts:
            return
        which = pair[n // starts]
        first = start[which.x]
        count = start[which.x + 1] - first
        second = start[which.y]
        others = start[which.y + 1] - second
        pose = guess[n]
        sums = Sums()
        blocks = Blocks()
        capture = rules.capture
        scale = rules.scale
        cosine = wp.cos(pose.z)
        sine = wp.sin(pose.z)
        iteration = int(0)
        settled = int(0)
        calm = int(0)
        moved = vec4()
        ahead = int(0)
        running = int(1)
        while running == 1 and iteration < rules.iterations and settled == 0 and count > 0:
            last = capture <= rules.least_capture and scale <= rules.least_scale
            sums = Sums()
            blocks = Blocks()
            stride = int(rules.stride)
            skip = int(rules.skip)
            full = last and rules.thin == 0
            if full:
                stride = 1
                skip = 1
            i = int(0)
            while i < others:
                p = point[second + i]
                arm = vec2(cosine * p.x - sine * p.y, sine * p.x + cosine * p.y)
                place = vec2(arm.x + pose.x, arm.y + pose.y)
                ahead = points_before(point, first, count, bearing_of(place), ahead)
                near = nearest_point(point, first, count, ahead, skip, place, capture * capture)
                pull = real(0.0)
                if near >= 0:
                    at = line[first + near]
                    if at.w > ZERO:
                        sums, pull = add_pairing(sums, at, place, arm, scale, last)
                if full:
                    blocks = add_to_blocks(blocks, i, pull)
                i += stride
            if full:
                blocks = close_blocks(blocks, others)
            iteration += 1
            step = solve(sums)
            if step.w == ZERO:
                running = 0
            else:
                length = wp.sqrt(step.x * step.x + step.y * step.y)
                most = HALF * rules.capture
                share = ONE
                if length > most:
                    share = most / length
                turn = wp.max(wp.min(step.z, LARGEST_TURN), -LARGEST_TURN)
                moved = vec4(share * step.x, share * step.y, turn, ZERO)
                pose = vec4(pose.x + share * step.x, pose.y + share * step.y, pose.z + turn, ZERO)
                cosine = wp.cos(pose.z)
                sine = wp.sin(pose.z)
                change = wp.max(length, wp.abs(turn))
                settled = int(last and change < rules.tolerance)
                calm = int(last and change < TEN * rules.tolerance)
                factor = rules.shrink
                if length < TENTH * scale and wp.abs(turn) < QUIET_TURN * scale and not last:
                    factor = rules.shrink * rules.shrink
                capture = wp.max(capture * factor, rules.least_capture)
                scale = wp.max(scale * factor, rules.least_scale)
        both = vec4()
        if count > 0 and others > 0:
            forward = vec4(pose.x, pose.y, cosine, sine)
            inverse = vec4(-cosine * pose.x - sine * pose.y, sine * pose.x - cosine * pose.y, cosine, -sine)
            stride = rules.score_stride
            skip = int(1)
            if rules.thin == 1:
                skip = rules.skip
            both = agreement(point, line, first, count, second, others, stride, skip, forward, rules.near, rules.gap)
            if rules.one_way == 0:
                both += agreement(
                    point, line, second, others, first, count, stride, skip, inverse, rules.near, rules.gap
                )
        everything = both.y + both.z + UNSEEN * both.w
        score = real(0.0)
        if everything > ZERO:
            score = (both.x - HALF * both.z) / everything
        out = n * MATCH_RESULT
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

    return locals()[name]
