"""Pairs of point-to-line ICP: nearest points, sums over pairs, and the agreement of two scans."""

import warp as wp

from .flags import IN_TEAMS
from .icp_step import (
    MATCH_BLOCKS,
    Blocks,
    Sums,
    add_joint_blocks,
    add_over_team,
    add_to_blocks,
    bearing_of,
    close_blocks,
    log_share,
    points_before,
)
from .types import real, vec2, vec4

ZERO, ONE, THREE = real(0.0), real(1.0), real(3.0)
FULL_TURN = real(6.283185307179586)
# Rounding errors of bounds are far below this share.
ALMOST = real(0.999)


@wp.func
def nearest_point(
    point: wp.array(dtype=vec4), first: wp.int32, count: wp.int32, ahead: wp.int32, skip: wp.int32, place: vec2,
    squared: real,
):  # fmt: skip
    """Return the nearest of every skip-th point within the square root of squared, -1 without one."""
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


@wp.func
def add_pairing(before: Sums, line: vec4, place: vec2, arm: vec2, scale: real, last: wp.bool):
    """Return the sums with a pair of a line and a place, and its weighted error."""
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


@wp.func
def agreement(
    point: wp.array(dtype=vec4), line: wp.array(dtype=vec4), first: wp.int32, count: wp.int32, second: wp.int32,
    others: wp.int32, stride: wp.int32, skip: wp.int32, pose: vec4, near: real, gap: real, member: wp.int32,
):  # fmt: skip
    """Return how well every stride-th point of one scan agrees with every skip-th point of another scan."""
    used = (others + stride - 1) // stride
    share = int(1 << log_share(used))
    k = int(member * share)
    end = wp.min(k + share, used)
    scale = near / THREE
    total = vec4()
    ahead = int(0)
    if member > 0:
        ahead = int(wp.int64(count) * wp.int64(k * stride) / wp.int64(others))
    while k < end:
        p = point[second + stride * k]
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
        k += 1
    if IN_TEAMS:
        numbers = Sums()
        for j in range(4):
            numbers[j] = total[j]
        numbers = add_over_team(numbers)
        for j in range(4):
            total[j] = numbers[j]
    return total


@wp.func
def sum_pairs(
    point: wp.array(dtype=vec4), line: wp.array(dtype=vec4), first: wp.int32, count: wp.int32, second: wp.int32,
    others: wp.int32, stride: wp.int32, skip: wp.int32, pose: vec4, capture: real, scale: real, last: wp.bool,
    full: wp.bool, member: wp.int32,
):  # fmt: skip
    """Return the sums over the pairs of a scan's points at a pose (x, y, cos, sin), and over blocks if full."""
    used = (others + stride - 1) // stride
    log = log_share(used)
    begin = int(member << log)
    own = wp.max(wp.min(used - begin, 1 << log), 0)
    levels = wp.min(log + 1, MATCH_BLOCKS)
    sums = Sums()
    blocks = Blocks()
    whole = real(0.0)
    ahead = int(0)
    if member > 0:
        ahead = int(wp.int64(count) * wp.int64(begin * stride) / wp.int64(others))
    k = int(0)
    while k < own:
        p = point[second + stride * (begin + k)]
        arm = vec2(pose.z * p.x - pose.w * p.y, pose.w * p.x + pose.z * p.y)
        place = vec2(arm.x + pose.x, arm.y + pose.y)
        ahead = points_before(point, first, count, bearing_of(place), ahead)
        near = nearest_point(point, first, count, ahead, skip, place, capture * capture)
        pull = real(0.0)
        if near >= 0:
            at = line[first + near]
            if at.w > ZERO:
                sums, pull = add_pairing(sums, at, place, arm, scale, last)
        if full:
            blocks = add_to_blocks(blocks, levels, k, pull)
        whole += pull
        k += 1
    if full:
        blocks = close_blocks(blocks, levels, own)
    if IN_TEAMS:
        sums = add_over_team(sums)
        if full:
            blocks = add_joint_blocks(blocks, log, whole)
            squares = Sums()
            for level in range(MATCH_BLOCKS):
                squares[level] = blocks[level]
            squares = add_over_team(squares)
            for level in range(MATCH_BLOCKS):
                blocks[level] = squares[level]
    return sums, blocks
