"""The likeliest joint association of a few features, in which no two features of one group have the same landmark."""

import math

import warp as wp

from gpusense.interface import feature_layout as at

from .flags import PER_BEAM
from .landmark_grid import log_match, may_match
from .landmarks import direction, sensor_place
from .log_terms import either, offset
from .prelude import kernel
from .types import real

ZERO, NEVER, EVERYWHERE = real(0.0), real(-math.inf), real(math.inf)
# A landmark's part of a density exceeds the false positive's if the density is more than twice the latter.
LOG_2 = real(0.69314718055994531)
# Largest number of features.
LogEach = wp.types.vector(length=8, dtype=real)


@wp.func
def add_landmark(
    j: wp.int32, log_each: LogEach, feature: wp.array(dtype=real), best: wp.array(dtype=real),
    choice: wp.array(dtype=wp.int32), value: wp.array(dtype=real), sums: wp.int32, begin: wp.int32,
    features: wp.int32, sets: wp.int32, groups: wp.int32,
):  # fmt: skip
    """Let landmark j be seen by one more feature of each set, at most one feature per group; log_each has the features'
    log p. The particle's sets begin at index sums of best, and their features at index begin of choice and value.
    """
    # From the full set down, since smaller sets must not yet contain this landmark for the group.
    step = int(0)
    while step < groups * (sets - 1):
        group = step // (sets - 1)
        s = sets - 1 - step % (sets - 1)
        k = int(0)
        while k < features:
            if ((s >> k) & 1) != 0 and int(feature[at.FEATURE * k + at.GROUP]) == group:
                less = s ^ (1 << k)
                joined = best[sums + less] + log_each[k]
                if joined > best[sums + s]:
                    best[sums + s] = joined
                    i = int(0)
                    while i < features:
                        if i == k:
                            choice[begin + s * features + i] = j
                            value[begin + s * features + i] = log_each[k]
                        else:
                            choice[begin + s * features + i] = choice[begin + less * features + i]
                            value[begin + s * features + i] = value[begin + less * features + i]
                        i += 1
            k += 1
        step += 1


@wp.func
def set_total(s: wp.int32, sum_of_set: real, feature: wp.array(dtype=real), features: wp.int32):
    """Return log p of all features if those of set s have landmarks and the remaining ones are false positives."""
    total = real(sum_of_set)
    k = int(0)
    while k < features:
        if ((s >> k) & 1) == 0:
            total += feature[at.FEATURE * k + at.FALSE_POSITIVE]
        k += 1
    return total


@wp.func
def best_set(
    best: wp.array(dtype=real), sums: wp.int32, feature: wp.array(dtype=real), features: wp.int32, sets: wp.int32
):
    """Return the set with the largest log p, and that. The particle's sets begin at index sums of best."""
    most = real(-math.inf)
    chosen = int(0)
    s = int(0)
    while s < sets:
        total = set_total(s, best[sums + s], feature, features)
        if total > most:
            most = total
            chosen = s
        s += 1
    return chosen, most


@kernel
def joint_features(
    landmark, normal, signature, pose_cell, pose, pose_low, feature, terms, arcs, best, choice, value, log_p, parts,
    which, landmarks, particles, features, sets, buckets, score,
):  # fmt: skip
    """Find the best joint association."""
    n = wp.tid()
    if n >= particles:
        return
    high = pose[n]
    low = pose_low[n]
    place = sensor_place(pose_cell[n], high, low, buckets.size)
    sums = n * sets
    begin = n * sets * features
    i = int(0)
    while i < sets:
        best[sums + i] = wp.where(i == 0, ZERO, NEVER)
        i += 1
    i = int(0)
    while i < sets * features:
        choice[begin + i] = -1
        value[begin + i] = NEVER
        i += 1
    groups = int(1)
    k = int(0)
    while k < features:
        groups = wp.max(groups, int(feature[at.FEATURE * k + at.GROUP]) + 1)
        k += 1
    log_each = LogEach()
    j = int(0)
    while j < landmarks:
        off = offset(landmark[j], place)
        k = int(0)
        while k < features:
            base = at.FEATURE * k
            turned = direction(high, low, feature, base)
            log_each[k] = NEVER
            if feature[base + at.RADIUS] >= ZERO:
                if may_match(off, turned, feature, base, normal, signature, j, EVERYWHERE):
                    detected = log_match(off, turned, feature, base, normal, signature, j, terms, arcs)
                    log_each[k] = either(detected, feature[base + at.FALSE_POSITIVE])
            k += 1
        add_landmark(j, log_each, feature, best, choice, value, sums, begin, features, sets, groups)
        j += 1
    chosen, most = best_set(best, sums, feature, features, sets)
    log_p[n] = wp.where(wp.isinf(most), most, score.temperature * (score.constant_term + most))
    if PER_BEAM:
        k = int(0)
        while k < features:
            false_positive = feature[at.FEATURE * k + at.FALSE_POSITIVE]
            each = value[begin + chosen * features + k]
            j = choice[begin + chosen * features + k]
            which[n * features + k] = wp.where(each - false_positive >= LOG_2, j, -1)
            parts[n * features + k] = wp.where(j >= 0, each, false_positive)
            k += 1
