"""Evidence for and against a pose on a whole map, and the probability that it is right.

The probability is a product of two: the pose explains the scan, and it is the right one among poses of nearly the same
score. The latter is 1/2 where a second pose is as good. Both are logistic functions;
``bench/derive/location_evidence.py`` fitted their weights to scans of half of the recorded logs and of simulated ones,
on the maps of the same and of other places; right and wrong poses have equal weight.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from gpusense.matching.location import PoseMode

NAMES = ("miss", "through", "short", "gap", "ahead")
"""Evidence for and against a pose.

``miss``: 1 less the score. ``through``, ``short``: shares of the hits that pass through walls of the map, and that end
    before them. ``gap``: lead in score over the second mode, relative to the depth to which modes are searched;
    infinite without a second mode. ``ahead``: lead in agreement over that mode.
"""

# Constant, and weights of the logarithms of miss, through and short: whether the pose explains the scan.
_CONSTANT = -6.73
_WEIGHTS = (-0.04, -4.83, 0.34)
# Weights of gap and ahead: whether it is the right one of two modes.
_RIVAL_WEIGHTS = (1.87, 5.22)
# Offsets added before logarithms are taken.
_LEAST = (3e-3, 1e-2, 1e-2)


def location_evidence(modes: Sequence[PoseMode], depth: float) -> np.ndarray:
    """Return the evidence (5,) on the first mode, see :data:`NAMES`; modes are searched down to ``depth``."""
    best = modes[0]
    rivals = [np.array([(best.score - mode.score) / depth, best.agreement - mode.agreement]) for mode in modes[1:]]
    strongest = min(rivals, key=rival_odds, default=np.array([math.inf, best.agreement]))
    return np.array([1 - best.score, best.through, best.short, *strongest])


def explained_logs(evidence: np.ndarray) -> np.ndarray:
    """Return the numbers (..., 3) that the first weights multiply."""
    logs: np.ndarray = np.log(np.maximum(evidence[..., :3], 0) + _LEAST)
    return logs


def rival_odds(gap_and_ahead: np.ndarray) -> float:
    """Return the log odds of the first mode against another mode."""
    gap, ahead = gap_and_ahead
    return math.inf if math.isinf(gap) else float(_RIVAL_WEIGHTS[0] * gap + _RIVAL_WEIGHTS[1] * ahead)


def probability_right(evidence: np.ndarray) -> float:
    """Return the probability that a pose is right."""
    explained = _CONSTANT + float(explained_logs(evidence) @ _WEIGHTS)
    return _logistic(explained) * _logistic(rival_odds(evidence[3:]))


def _logistic(x: float) -> float:
    return 1 / (1 + math.exp(-min(max(x, -50.0), 50.0)))
