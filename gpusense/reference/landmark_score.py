"""Likelihood of a set of features for each particle, log p(f | x, m): the sum over features (tables 6.4 and 6.5).

And negative information: landmarks that the sensor should see from a pose, but that match no feature.
"""

from __future__ import annotations

import numpy as np

from gpusense.interface.constants import BLOCK_TERMS
from gpusense.interface.feature_layout import FALSE_POSITIVE, FEATURE
from gpusense.reference.error_free import add_term
from gpusense.reference.landmark_grid import BLOCK_PAIRS, bucket_at, log_match, search
from gpusense.reference.landmarks import at_places, direction, sensor_place
from gpusense.reference.log_terms import Quad, either, offset

# Particles per block.
BLOCK = 1 << 14


def score_features(
    flags, landmark, normal, signature, start, pose_cell, pose, pose_low, feature, partner, terms, arcs, log_p,
    parts, which, buckets, landmarks, particles, features, share, score,
):  # fmt: skip
    """Sum log p over features: with the KNOWN partner, all landmarks (MARGINAL) or the likeliest one.

    PER_BEAM: ``parts`` receives the term of each feature, and ``which`` the index of its likeliest landmark, -1 if a
        false positive is likelier. ``share`` is log(1 / landmarks), the prior of a landmark, if MARGINAL, else 0.
    """
    numbers = feature.reshape(-1)[: FEATURE * features].reshape(-1, FEATURE)
    for begin in range(0, particles, BLOCK):
        part = slice(begin, min(begin + BLOCK, particles))
        place = sensor_place(pose_cell[part], pose[part], pose_low[part], buckets.size)
        count = len(place[0])
        total = (np.full(count, score.constant_term, pose.dtype), np.zeros(count, pose.dtype))
        impossible = np.full(count, np.isneginf(score.constant_term))
        for k in range(0, features, BLOCK_TERMS):
            block = np.zeros(count, pose.dtype)
            for i in range(k, min(k + BLOCK_TERMS, features)):
                one, turned = numbers[i], direction(pose[part], pose_low[part], numbers[i])
                if "KNOWN" in flags:
                    j = np.full(count, partner[i])
                    off = offset(landmark[j], place)
                    detected = log_match(flags, off, turned, one, normal, signature, j, terms, arcs)
                    best, chosen = detected, j
                else:
                    detected, best, chosen = search(
                        flags, landmark, normal, signature, start, place, turned, one, terms, arcs, buckets
                    )
                value = either(detected + share, one[FALSE_POSITIVE])
                impossible |= np.isneginf(value)
                block += np.where(np.isneginf(value), 0, value)
                if "PER_BEAM" in flags:
                    at = np.arange(part.start, part.stop) * features + i
                    parts[at] = value
                    which[at] = np.where(best + share >= one[FALSE_POSITIVE], chosen, -1)
            total = add_term(total, block)
        log_p[part] = np.where(impossible, -np.inf, score.temperature * (total[0] + total[1]))


def in_view(off: Quad, cosine: np.ndarray, sine: np.ndarray, range_max: float, least: float) -> np.ndarray:
    """Return whether landmarks are within range, with a cosine of the angle to the sensor's axis >= ``least``."""
    d = np.sqrt(off[0] * off[0] + off[2] * off[2])
    return (d <= range_max) & (cosine * off[0] + sine * off[2] >= least * d)


def count_unseen(flags, landmark, start, pose_cell, pose, pose_low, which, log_p, buckets, particles, features, view):
    """Add ``log_missed`` to log_p for every landmark in view that belongs to no feature."""
    block = max(BLOCK_PAIRS // max(int(start[buckets.rows * buckets.cols]), 1), 1)
    for begin in range(0, particles, block):
        part = slice(begin, min(begin + block, particles))
        place = sensor_place(pose_cell[part], pose[part], pose_low[part], buckets.size)
        cosine = pose[part, 2] * view.axis_cosine - pose[part, 3] * view.axis_sine
        sine = pose[part, 3] * view.axis_cosine + pose[part, 2] * view.axis_sine
        low, high = (
            bucket_at(place[2] - view.range_max, buckets.size, buckets.rows),
            bucket_at(place[2] + view.range_max, buckets.size, buckets.rows),
        )
        first, last = int(start[low.min() * buckets.cols]), int(start[(high.max() + 1) * buckets.cols])
        for n in range(len(low)):
            sensor = at_places(place, slice(n, n + 1))
            seen = in_view(offset(landmark[first:last], sensor), cosine[n], sine[n], view.range_max, view.least)
            at = (begin + n) * features
            taken = np.unique(which[at : at + features])
            taken = taken[(taken >= first) & (taken < last)] - first
            unseen = np.count_nonzero(seen) - np.count_nonzero(seen[taken])
            if unseen:
                log_p[begin + n] += unseen * view.log_missed
