// Lines through LANES points of a scan at once: line_fit.cl.
// requires: lanes/math lanes/error_free

// Most neighbours on either side.
#define MOST 48

// in lanes: WHOLE_TURN line_through

// Write the lines of up to LANES points of a scan from begin on; see line_at of line_fit.cl.
void fit_block(global const real4 *point, const int count, const int begin, const int reach, const int most,
               const real ratio, const real slack, const real width, const real gap, global real4 *line) {
    // Points from MOST before the block to MOST behind it.
    real x[LANES + 2 * MOST], y[LANES + 2 * MOST], range[LANES + 2 * MOST], angle[LANES + 2 * MOST];
    for (int i = 0, k = begin - most; i < LANES + 2 * most; ++i, ++k) {
        k = k < 0 ? k + count : k >= count ? k - count : k;
        const real4 p = point[k < 0 || k >= count ? 0 : k];
        x[i] = p.x, y[i] = p.y, angle[i] = p.z, range[i] = p.w;
    }
    const lanes centre_x = load_lanes(0, x + most), centre_y = load_lanes(0, y + most);
    const lanes centre_range = load_lanes(0, range + most), centre_angle = load_lanes(0, angle + most);
    lanes sum_x = 0, sum_y = 0, xx = 0, xy = 0, yy = 0, size = 1;
    for (int direction = -1; direction <= 1; direction += 2) {
        lanes last_x = centre_x, last_y = centre_y, last_range = centre_range, last_angle = centre_angle;
        ilanes joined = -1;
        for (int j = 1; j <= most && 2 * j < count; ++j) {
            const int at = most + direction * j;
            const lanes next_x = load_lanes(0, x + at), next_y = load_lanes(0, y + at);
            const lanes between_x = next_x - last_x, between_y = next_y - last_y;
            const lanes dx = next_x - centre_x, dy = next_y - centre_y, farthest = slack + ratio * last_range;
            const lanes next_angle = load_lanes(0, angle + at), turn = fabs(next_angle - last_angle);
            joined &= between_x * between_x + between_y * between_y <= farthest * farthest;
            joined &= fmin(turn, WHOLE_TURN - turn) <= gap;
            if (j > reach) joined &= dx * dx + dy * dy <= width * width;
            if (!any_lane(joined)) break;
            sum_x += joined ? dx : (lanes)0;
            sum_y += joined ? dy : (lanes)0;
            xx += joined ? dx * dx : (lanes)0;
            xy += joined ? dx * dy : (lanes)0;
            yy += joined ? dy * dy : (lanes)0;
            size += joined ? (lanes)1 : (lanes)0;
            last_x = next_x, last_y = next_y, last_angle = next_angle, last_range = load_lanes(0, range + at);
        }
    }
    const LaneQuad centre = {centre_x, centre_y, centre_angle, centre_range};
    const LaneQuad fitted = line_through_lanes(centre, (LanePair){sum_x, sum_y}, xx, xy, yy, size);
    for (int i = 0; i < LANES && begin + i < count; ++i)
        line[begin + i] = (real4)(((const real *)&fitted.x)[i], ((const real *)&fitted.y)[i],
                                  ((const real *)&fitted.z)[i], ((const real *)&fitted.w)[i]);
}

// Write the lines of all points of a scan.
void fit_scan(global const real4 *point, const int count, const int reach, const int most, const real ratio,
              const real slack, const real width, const real gap, global real4 *line) {
    for (int k = 0; k < count; k += LANES) fit_block(point, count, k, reach, most, ratio, slack, width, gap, line);
}

// Fit lines to LANES points and at most MOST neighbours on either side.
kernel void fit_lines(ARGUMENTS) {
    const int begin = LANES * get_global_id(0), scan = which[get_global_id(1)];
    const int first = start[scan], count = start[scan + 1] - first;
    if (begin >= count) return;
    fit_block(point + first, count, begin, reach, most, ratio, slack, width, gap, line + first);
}
