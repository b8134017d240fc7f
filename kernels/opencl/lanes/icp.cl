// Scan matching by point-to-line ICP for LANES points of a scan at once: match_scans of icp.cl.
// requires: lanes/icp_pairs icp_match

// Match scans: one work-item takes a pair (reference, second scan, level of its rules) and a guess (x, y, theta), the
// pose of the second scan in the reference's frame. one_way excludes the reference's points from the score.
kernel void match_scans(ARGUMENTS) {
    const int n = get_global_id(0);
    if (n >= pairs * starts) return;
    const Team team = {0};
    match_in_turns(point, start, line, pair + 3 * (n / starts), guess[n], rules, result + (long)MATCH_RESULT * turns * n,
                   turns, far, far_turn, team);
}
