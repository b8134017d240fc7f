"""Scan matching by point-to-line ICP with exact nearest points; see icp_pairs.py and icp_match.py."""

from __future__ import annotations

import numpy as np

from gpusense.interface import structs
from gpusense.interface.constants import MATCH_RESULT
from gpusense.reference.icp_match import match_pair


def match_scans(
    flags: frozenset[str], point: np.ndarray, start: np.ndarray, line: np.ndarray, pair: np.ndarray, guess: np.ndarray,
    result: np.ndarray, scans: int, points: int, pairs: int, starts: int, rules: structs.MatchRules,
) -> None:  # fmt: skip
    """Match pairs of scans (reference, second scan) from guesses (x, y, theta).

    A guess is the pose of the second scan in the reference's frame. With ``one_way`` the reference's points do not
    count in the score. A result is the pose (3), the score, iterations, whether the last step was below ten tolerances,
    the information (6), its part that is due to errors of the lines (6), pairs, sum of weights, weighted sum of squared
    errors, points that the other scan should see, points through which it saw, points that it did not see, and for
    blocks of 1, 2, 4 to 128 successive points the sum of squares of the blocks' sums of weighted errors (8), 0 with
    ``thin``; the last step (3).
    """
    for n, out in enumerate(result[: MATCH_RESULT * pairs * starts].reshape(-1, MATCH_RESULT)):
        match_pair(point, start, line, pair[n // starts], guess[n, :3], out, rules)
