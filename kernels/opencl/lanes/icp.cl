// Scan matching by point-to-line ICP for LANES points of a scan at once: match_scans of icp.cl.
// requires: lanes/icp_pairs icp_match

// in lanes: match_scans
