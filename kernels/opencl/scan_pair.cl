// A pair of scans, from their readings: noise, points and lines, for match_scans of icp.cl.
// requires: line_fit sorting pair_steps

// Place two scans of one scanner, a reference and a second one: points of their hits by bearing, with lines for the noise of
// the pair; the pair itself, with the row of its rules, which depends on its level of noise and on the stride of its second
// scan; and its level, points and sums of squared ranges. One work-item takes the pair.
kernel void place_pair(ARGUMENTS) {
    if (get_global_id(0) > 0) return;
    double noise = -1;
    double2 scan[2];
    for (int i = 0; i < 2; ++i) {
        global const double *mine = reading + beams * i;
        const double own = noise_of(mine, weight, places, padded, step, nearest, farthest, work);
        noise = own > noise ? own : noise;
        scan[i] = place_points(mine, beam, beams, nearest, farthest, point + (i > 0 ? (int)scan[0].s0 : 0));
    }
    const int first = (int)scan[0].s0, second = (int)scan[1].s0, chosen = level_of(noise, level, levels, assumed);
    const real slack = (real)level[2 * chosen + 1];
    fit_scan(point, first, reach, most, ratio, slack, width, gap, line);
    fit_scan(point + first, second, reach, most, ratio, slack, width, gap, line + first);
    start[0] = 0, start[1] = first, start[2] = first + second;
    pair[0] = 0, pair[1] = 1, pair[2] = strides * chosen + min(max(second / coarse, 1), strides) - 1;
    summary[0] = chosen, summary[1] = first, summary[2] = second, summary[3] = scan[0].s1, summary[4] = scan[1].s1;
}
