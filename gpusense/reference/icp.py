"""Scan matching by point-to-line ICP with exact nearest points; see icp_pairs.py and icp_match.py."""

from gpusense.interface.constants import MATCH_RESULT, MATCH_RULES
from gpusense.reference.icp_match import match_in_turns, rules_of


def match_scans(
    flags, point, start, line, pair, guess, rules, result, scans, points, pairs, starts, levels, turns, far,
    far_turn,
):  # fmt: skip
    """Match pairs of scans (reference, second scan, level of its rules) from guesses (x, y, theta).

    A guess is the pose of the second scan in the reference's frame. ``one_way`` excludes the reference's points from
    the score. A result is the pose (3), the score, iterations, whether the last step was below ten tolerances, the
    information (6), its part that is due to errors of the lines (6), pairs, sum of weights, weighted sum of squared
    errors, points that the other scan should see, points through which it saw, points that it did not see, and for
    blocks of 1, 2, 4 to 128 successive points the sum of squares of the blocks' sums of weighted errors (8), 0 with
    ``thin``; the last step (3). Two turns match pairs again from results that are farther from their guesses than
    ``far`` along an axis or ``far_turn``.
    """
    which, of = pair[: 3 * pairs].reshape(-1, 3), rules[: MATCH_RULES * levels].reshape(-1, MATCH_RULES)
    for n, out in enumerate(result[: MATCH_RESULT * turns * pairs * starts].reshape(-1, turns, MATCH_RESULT)):
        first, second, level = which[n // starts]
        match_in_turns(point, start, line, (first, second), guess[n, :3], rules_of(of[level]), out, far, far_turn)
