"""Likelihood of a set of features for each particle, log p(f | x, m): the sum over features (tables 6.4 and 6.5)."""

from __future__ import annotations

import numpy as np

from gpusense.interface import structs
from gpusense.interface.constants import BLOCK_TERMS
from gpusense.interface.feature_layout import FALSE_POSITIVE, FEATURE
from gpusense.reference.error_free import add_term
from gpusense.reference.landmark_grid import log_match, search
from gpusense.reference.landmarks import direction, sensor_place
from gpusense.reference.log_terms import either
from gpusense.reference.offsets import offset

# Particles per block.
BLOCK = 1 << 14


def score_features(
    flags: frozenset[str], landmark: np.ndarray, normal: np.ndarray, signature: np.ndarray, start: np.ndarray,
    pose_cell: np.ndarray, pose: np.ndarray, pose_low: np.ndarray, feature: np.ndarray, partner: np.ndarray,
    terms: structs.FeatureTerms, arcs: np.ndarray, log_p: np.ndarray, parts: np.ndarray, which: np.ndarray,
    buckets: structs.Buckets, landmarks: int, particles: int, features: int, share: float, score: structs.Score,
) -> None:  # fmt: skip
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
