"""Scan matching by point-to-line ICP with exact nearest points; see icp_pairs.py and icp_match.py."""

import warp as wp

from gpusense.interface.constants import MATCH_RESULT

from .icp_match import match_in_turns
from .icp_step import TEAM
from .prelude import kernel, work_item


@kernel
def match_scans(
    point, start, line, pair, guess, rules, result, scans, points, pairs, starts, levels, turns, far, far_turn
):  # fmt: skip
    """Match pairs of scans from guesses: a work-item, or with IN_TEAMS a team of them, takes a pair."""
    item = work_item(wp.tid())
    n = item // TEAM
    if n < pairs * starts:
        match_in_turns(
            point, start, line, pair, 3 * (n // starts), guess[n], rules, result, n * MATCH_RESULT * turns, turns,
            far, far_turn, item - n * TEAM,
        )  # fmt: skip
