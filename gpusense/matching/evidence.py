"""Evidence for and against a match, and the probability that its pose is right.

The probability is a logistic function of the evidence that the scans give at the pose. Its weights were fitted by
``bench/derive/match_evidence.py`` to matches of scans from simulations and from half of the recorded logs, of
neighbouring places and of places without anything in common; right and wrong poses have equal weight.
``bench/accuracy/match_verdicts.py`` compares predicted and actual shares of right matches for both halves.
"""

from __future__ import annotations

import math

import numpy as np

from gpusense.matching.columns import Column, column_of, columns_of, larger, rows_of, smaller, square_root, values_of

NAMES = ("disagreement", "contradiction", "overlap", "pairs", "roughness", "misfit", "lost", "rival", "distance")
"""Evidence for and against a match.

``disagreement``: 1 less the score. ``contradiction``: share of the points in common sight that one scan saw through.
``overlap``: share of all points that are in common sight. ``pairs``: number of pairs of points. ``roughness``: root
mean square error of pairs over the noise. ``misfit``: 1 less the mean weight of pairs. ``lost``: number of directions
that are not observed. ``rival``: 1 where another pose agrees about equally well. ``distance``: distance from the guess
over the window's half width.
"""

# A fully observed pose is doubtful below the first probability, a partly observed one below the second: it is used only
# along its observed directions, together with its p_right.
DOUBTED, DOUBTED_PARTLY = 0.65, 0.03
# Constant, then weights: of the logarithms of disagreement, contradiction, overlap, pairs, roughness and misfit, of one
# lost direction, of a second one, of a rival, and of the logarithm of the distance.
_CONSTANT = -3.123
_WEIGHTS = (-1.350, -0.164, 1.574, -0.067, -0.202, -0.692, -1.395, 0.622, -2.158, -1.788)
# Offset of distances, and lower bounds of the arguments of logarithms; of lost and rival there are none.
_NEAR = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.04])
_LEAST = np.array([1e-3, 3e-3, 1e-3, 1.0, 0.1, 1e-2, 1.0, 1.0, 0.0])
# Logarithm of the largest odds against a pose: the exponential of larger ones overflows.
_MOST = 700.0


def pair_evidence(result: np.ndarray, lost: Column, other: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Return the evidence (S, 9) of results (S, 35) of ``match_scans``, see :data:`NAMES`; the distance is 0.

    ``other`` (S, 3) are offsets to poses that agree about as well, NaN without one; ``noise`` (S,) are
    deviations of ranges [m].
    """
    numbers = columns_of(result)
    weights, squared, seen, through, unseen = numbers[19:24]
    pairs, common = larger(numbers[18], 1.0), larger(seen + through, 1.0)
    rough = square_root(squared / larger(weights, 1e-30)) / larger(column_of(noise), 1e-6)
    values = (
        1 - numbers[3], through / common, seen / larger(common + unseen, 1.0), pairs, smaller(rough, 20.0),
        1 - weights / pairs, lost, has_rival(other), 0.0 * pairs,
    )  # fmt: skip
    return rows_of(values)


def has_rival(other: np.ndarray) -> Column:
    """Return whether there are offsets (S, 3) to other poses: NaN for none."""
    x, y, turn = columns_of(other)
    total = x + y + turn
    return np.isfinite(total) if isinstance(total, np.ndarray) else math.isfinite(total)


def features_of(evidence: np.ndarray) -> list[Column]:
    """Return the ten columns that the weights multiply."""
    logarithms, (lost, rival) = columns_of(np.log(np.maximum(evidence + _NEAR, _LEAST))), columns_of(evidence)[6:8]
    return [*logarithms[:6], lost > 0, lost > 1, rival, logarithms[8]]


def probability_right(evidence: np.ndarray) -> np.ndarray:
    """Return the probabilities (S,) that poses are right along their observed directions."""
    total: Column = _CONSTANT
    for weight, feature in zip(_WEIGHTS, features_of(evidence), strict=True):
        total = total + weight * feature
    return values_of(1 / (1 + np.exp(smaller(-total, _MOST))))
