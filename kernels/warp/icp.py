"""Scan matching by point-to-line ICP with exact nearest points; see icp_pairs.py and icp_match.py."""

import functools

import warp as wp

from . import icp_match
from .icp_match import MATCH_RESULT
from .icp_step import TEAM
from .prelude import kernel, work_item


@functools.cache
def make(name, flags):
    """Make a kernel of the file for a set of flags."""
    match_pair = icp_match.functions(flags).match_pair
    MEMBERS = TEAM if "IN_TEAMS" in flags else 1

    # Match scans: a work-item, or with IN_TEAMS a team of them, takes a pair (reference, second scan) and a guess (x,
    # y, theta), the pose of the second scan in the reference's frame. With one_way the reference's points do not count
    # in the score.
    @kernel(flags)
    def match_scans(point, start, line, pair, guess, result, scans, points, pairs, starts, rules):
        item = work_item(wp.tid())
        n = item // MEMBERS
        if n < pairs * starts:
            match_pair(
                point, start, line, pair[n // starts], guess[n], result, n * MATCH_RESULT, rules, item - n * MEMBERS
            )

    return locals()[name]
