// Lines through LANES points of a scan at once: fit_lines of lines.cl.
// requires: lanes/line_fit

// Fit lines to LANES points and at most MOST neighbours on either side.
kernel void fit_lines(ARGUMENTS) {
    const int begin = LANES * get_global_id(0), scan = which[get_global_id(1)];
    const int first = start[scan], count = start[scan + 1] - first;
    if (begin >= count) return;
    fit_block(point + first, count, begin, reach, most, ratio, slack, width, gap, line + first);
}
