"""Evidence for and against a match, and the probability that its pose is right."""

from __future__ import annotations

import numpy as np

NAMES = ("disagreement", "contradiction", "overlap", "pairs", "roughness", "lost", "rival")
DOUBTED = -1.0


def pair_evidence(result, lost, other, options):
    seen, through, unseen = result[:, 21], result[:, 22], result[:, 23]
    whole = np.maximum(seen + through + unseen, 1)
    squared = result[:, 20] / np.maximum(result[:, 19], 1e-30)
    return np.stack(
        [
            1 - result[:, 3],
            through / np.maximum(seen + through, 1),
            seen / whole,
            np.log(np.maximum(result[:, 18], 1)),
            np.log(np.sqrt(squared) / options.noise + 1e-3),
            lost.astype(float),
            np.isfinite(other).all(axis=1).astype(float),
            result[:, 19] / np.maximum(result[:, 18], 1),
            seen,
            through,
            unseen,
        ],
        axis=1,
    )


def probability_right(evidence):
    return np.full(len(evidence), 0.5)
