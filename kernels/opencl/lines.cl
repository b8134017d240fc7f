// Lines through the points of scans, for point-to-line ICP; see line_fit.cl.
// requires: line_fit

// Fit a line to each point and reach neighbours on either side, up to most within a distance of width, none of them
// farther from the last one than slack plus ratio times its range, nor than gap in bearing: unit normal, offset, and 1
// / (sum of squared distances along the line). A point without neighbours has a line perpendicular to its beam, -1 in
// place of that sum, and no pairs. One work-item takes a point of a chosen scan.
kernel void fit_lines(ARGUMENTS) {
    const int k = get_global_id(0), scan = which[get_global_id(1)];
    const int first = start[scan], count = start[scan + 1] - first;
    if (k >= count) return;
    line[first + k] = line_at(point + first, count, k, reach, most, ratio, slack, width, gap);
}
