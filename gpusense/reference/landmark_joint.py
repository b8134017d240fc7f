"""The likeliest joint association of a few features, in which no two features of one group have the same landmark.

Features without a landmark are false positives. Points are all of one group; lines that do not overlap are of
different groups, since one wall may be seen in pieces. Landmarks are processed one after the other. A set s of
features is a bit mask; ``best[s]`` is the largest sum of log p over the features of s when all of them have landmarks
that were processed. A landmark can add one feature of each group to a set: 2^features * features steps per landmark
and group, and the maximum is exact.
"""

from __future__ import annotations

import itertools

import numpy as np

from gpusense.interface.feature_layout import FALSE_POSITIVE, FEATURE, GROUP, RADIUS
from gpusense.reference.landmark_grid import log_match, may_match
from gpusense.reference.landmarks import direction, sensor_place
from gpusense.reference.log_terms import either, offset

# A landmark's part of a density exceeds the false positive's if the density is more than twice the latter.
LOG_2 = 0.69314718055994531


def add_landmark(
    j: int, log_each: np.ndarray, numbers: np.ndarray, best: np.ndarray, choice: np.ndarray, value: np.ndarray
) -> None:
    """Let landmark j be seen by one more feature of each set, at most one feature per group.

    ``log_each``: (F, N) log p of the features; ``best``: (N, 2^F) largest sums of the sets; ``choice``, ``value``:
    (N, 2^F, F) landmarks of their features, and log p.
    """
    sets, groups = best.shape[1], int(numbers[:, GROUP].max(initial=0)) + 1
    # From the full set down, since smaller sets must not yet contain this landmark for the group.
    for group, s in itertools.product(range(groups), range(sets - 1, 0, -1)):
        for k in range(len(numbers)):
            if s >> k & 1 and numbers[k, GROUP] == group:
                less = s ^ 1 << k
                joined = best[:, less] + log_each[k]
                better = joined > best[:, s]
                best[better, s] = joined[better]
                choice[better, s], value[better, s] = choice[better, less], value[better, less]
                choice[better, s, k], value[better, s, k] = j, log_each[k, better]


def set_total(s: int, sums: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """Return log p of all features if those of set s have landmarks and the remaining ones are false positives."""
    total = sums.copy()
    for k in range(len(numbers)):
        if not s >> k & 1:
            total = total + numbers[k, FALSE_POSITIVE]
    return total


def best_set(sums: np.ndarray, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the sets with the largest log p, and these, from the (N, 2^F) largest sums of the sets."""
    most, chosen = np.full(len(sums), -np.inf, sums.dtype), np.zeros(len(sums), np.int64)
    for s in range(sums.shape[1]):
        total = set_total(s, sums[:, s], numbers)
        better = total > most
        most[better], chosen[better] = total[better], s
    return chosen, most


def joint_features(
    flags, landmark, normal, signature, pose_cell, pose, pose_low, feature, terms, arcs, best, choice, value, log_p,
    parts, which, landmarks, particles, features, sets, buckets, score,
):  # fmt: skip
    """Find the best joint association of each particle.

    ``choice[s]`` has the landmark of each feature of set s, and ``value[s]`` its log p; ``sets`` is 2^features.
    """
    real = pose.dtype
    numbers = feature.reshape(-1)[: FEATURE * features].reshape(-1, FEATURE)
    place = sensor_place(pose_cell[:particles], pose[:particles], pose_low[:particles], buckets.size)
    turned = [direction(pose[:particles], pose_low[:particles], one) for one in numbers[:features]]
    sums = best[: particles * sets].reshape(particles, sets)
    partners = choice[: particles * sets * features].reshape(particles, sets, features)
    each = value[: particles * sets * features].reshape(particles, sets, features)
    sums[:], partners[:], each[:] = -np.inf, -1, -np.inf
    sums[:, 0] = 0
    for j in range(landmarks):
        off = offset(landmark[j : j + 1], place)
        same = np.full(particles, j)
        log_each = np.full((features, particles), -np.inf, real)
        for k in range(features):
            if numbers[k, RADIUS] >= 0:
                detected = log_match(flags, off, turned[k], numbers[k], normal, signature, same, terms, arcs)
                detected = either(detected, numbers[k, FALSE_POSITIVE])
                may = may_match(flags, off, turned[k], numbers[k], normal, signature, same)
                log_each[k] = np.where(may, detected, -np.inf)
        add_landmark(j, log_each, numbers[:features], sums, partners, each)
    chosen, most = best_set(sums, numbers[:features])
    log_p[:particles] = np.where(np.isneginf(most), most, score.temperature * (score.constant_term + most))
    if "PER_BEAM" in flags:
        n = np.arange(particles)
        detected, values = partners[n, chosen], each[n, chosen]
        false = numbers[:features, FALSE_POSITIVE]
        which[: particles * features] = np.where(values - false >= real.type(LOG_2), detected, -1).ravel()
        parts[: particles * features] = np.where(detected >= 0, values, false).ravel()
