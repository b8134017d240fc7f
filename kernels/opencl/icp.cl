// Scan matching by point-to-line ICP with exact nearest points; see icp_pairs.cl and icp_match.cl.
// requires: icp_pairs icp_match

// Match scans: a work-item, or with IN_TEAMS a team of them, takes a pair (reference, second scan, level of its rules)
// and a guess (x, y, theta), the pose of the second scan in the reference's frame. one_way excludes the reference's
// points from the score.
kernel void match_scans(ARGUMENTS) {
#if IN_TEAMS
    local real shared[TEAM * AT_ONCE];
    const int n = get_group_id(0);
    const Team team = {get_local_id(0), shared};
#else
    const int n = get_global_id(0);
    const Team team = {0};
#endif
    if (n >= pairs * starts) return;
    match_in_turns(point, start, line, pair + 3 * (n / starts), guess[n], rules, result + (long)MATCH_RESULT * turns * n,
                   turns, far, far_turn, team);
}
