"""Likelihood of a set of features for each particle, log p(f | x, m): the sum over features (tables 6.4 and 6.5)."""

import math

import warp as wp

from gpusense.interface import feature_layout as at
from gpusense.interface.constants import BLOCK_TERMS

from .error_free import add_term
from .flags import FIELD, KNOWN, PER_BEAM
from .landmark_grid import bucket_at, log_match, search
from .landmarks import direction, sensor_place
from .log_terms import either, offset
from .prelude import kernel
from .types import real, vec2, vec4

ZERO, NEVER = real(0.0), real(-math.inf)


@kernel
def score_features(
    landmark, normal, signature, start, pose_cell, pose, pose_low, feature, partner, terms, arcs, log_p, parts,
    which, buckets, landmarks, particles, features, share, score,
):  # fmt: skip
    """Sum log p over features: with the KNOWN partner, all landmarks (MARGINAL) or the likeliest one."""
    n = wp.tid()
    if n >= particles:
        return
    high = pose[n]
    low = pose_low[n]
    place = sensor_place(pose_cell[n], high, low, buckets.size)
    total = vec2(score.constant_term, ZERO)
    impossible = bool(wp.isinf(score.constant_term))
    first = int(0)
    while first < features:
        last = wp.min(first + BLOCK_TERMS, features)
        block = real(0.0)
        k = first
        while k < last:
            base = at.FEATURE * k
            turned = direction(high, low, feature, base)
            detected = real(0.0)
            best = real(0.0)
            chosen = int(0)
            if KNOWN:
                chosen = partner[k]
                off = offset(landmark[chosen], place)
                detected = log_match(off, turned, feature, base, normal, signature, chosen, terms, arcs)
            else:
                match = search(landmark, normal, signature, start, place, turned, feature, base, terms, arcs, buckets)
                detected = match.log_p
                best = match.best
                chosen = match.chosen
            value = either(detected + share, feature[base + at.FALSE_POSITIVE])
            if wp.isinf(value):
                impossible = True
            else:
                block += value
            if PER_BEAM:
                parts[n * features + k] = value
                if KNOWN:
                    which[n * features + k] = chosen
                else:
                    which[n * features + k] = wp.where(best + share >= feature[base + at.FALSE_POSITIVE], chosen, -1)
            k += 1
        total = add_term(total, block)
        first = last
    log_p[n] = wp.where(impossible, NEVER, score.temperature * (total[0] + total[1]))


@wp.func
def in_view(off: vec4, cosine: real, sine: real, range_max: real, least: real):
    """Return whether a landmark is within range and, with a FIELD, in the field of view."""
    d = wp.sqrt(off[0] * off[0] + off[2] * off[2])
    seen = d <= range_max
    if FIELD:
        seen = seen and cosine * off[0] + sine * off[2] >= least * d
    return seen


@kernel
def count_unseen(landmark, start, pose_cell, pose, pose_low, which, log_p, buckets, particles, features, view):
    """Add log_missed to log_p for every landmark in view that belongs to no feature."""
    n = wp.tid()
    if n >= particles:
        return
    sensor_pose = pose[n]
    place = sensor_place(pose_cell[n], sensor_pose, pose_low[n], buckets.size)
    cosine = sensor_pose[2] * view.axis_cosine - sensor_pose[3] * view.axis_sine
    sine = sensor_pose[3] * view.axis_cosine + sensor_pose[2] * view.axis_sine
    left = bucket_at(place[0] - view.range_max, buckets.size, buckets.cols)
    right = bucket_at(place[0] + view.range_max, buckets.size, buckets.cols)
    high = bucket_at(place[2] + view.range_max, buckets.size, buckets.rows)
    unseen = int(0)
    row = bucket_at(place[2] - view.range_max, buckets.size, buckets.rows)
    while row <= high:
        j = start[row * buckets.cols + left]
        last = start[row * buckets.cols + right + 1]
        while j < last:
            if in_view(offset(landmark[j], place), cosine, sine, view.range_max, view.least):
                taken = int(0)
                k = int(0)
                while k < features:
                    if which[n * features + k] == j:
                        taken = 1
                    k += 1
                unseen += 1 - taken
            j += 1
        row += 1
    if unseen > 0:
        log_p[n] = log_p[n] + real(unseen) * view.log_missed
