// Lines through the points of a scan and their neighbours, for point-to-line ICP: total least squares.

#define WHOLE_TURN ((real)6.283185307179586)

// Return the line through a point and its neighbours, a unit normal, an offset, and 1 / (sum of squared distances along the
// line), from sums of the neighbours' coordinates relative to the point and of their products. A point without
// neighbours gets the line perpendicular to its beam, and -1 instead of the sum.
real4 line_through(const real4 centre, const real2 sum, const real xx, const real xy, const real yy, const real size) {
    const real mean_x = sum.x / size, mean_y = sum.y / size;
    const real a = xx - size * mean_x * mean_x, b = xy - size * mean_x * mean_y, d = yy - size * mean_y * mean_y;
    const real middle = (real)0.5 * (a - d), root = sqrt(middle * middle + b * b);
    const real along_x = middle >= 0 ? middle + root : b, along_y = middle >= 0 ? b : root - middle;
    const real size_along = sqrt(along_x * along_x + along_y * along_y);
    // 0 without a direction.
    const real length = size_along > 0 ? (real)0.5 * (a + d) + root : (real)0;
    const real x = length > 0 ? along_x : -centre.y, y = length > 0 ? along_y : centre.x;
    const real total = length > 0 ? size_along : centre.w, normal_x = -y / total, normal_y = x / total;
    const real offset = normal_x * (centre.x + mean_x) + normal_y * (centre.y + mean_y);
    return (real4)(normal_x, normal_y, offset, length > 0 ? 1 / length : (real)-1);
}

// Return the line through the k-th point of a scan and reach neighbours on either side, up to most within a distance of
// width, none of them farther from the last one than slack plus ratio times its range, nor than gap in bearing.
real4 line_at(global const real4 *point, const int count, const int k, const int reach, const int most, const real ratio,
              const real slack, const real width, const real gap) {
    const real4 centre = point[k];
    real2 sum = (real2)(0);
    real xx = 0, xy = 0, yy = 0;
    int size = 1;
    for (int direction = -1; direction <= 1; direction += 2) {
        real4 last = centre;
        for (int j = 1; j <= most && 2 * j < count; ++j) {
            int i = k + direction * j;
            i = i >= count ? i - count : i < 0 ? i + count : i;
            const real4 next = point[i];
            const real2 between = next.xy - last.xy, d = next.xy - centre.xy;
            const real farthest = slack + ratio * last.w, turn = fabs(next.z - last.z);
            if (between.x * between.x + between.y * between.y > farthest * farthest) break;
            if (fmin(turn, WHOLE_TURN - turn) > gap) break;
            if (j > reach && d.x * d.x + d.y * d.y > width * width) break;
            sum += d;
            xx += d.x * d.x;
            xy += d.x * d.y;
            yy += d.y * d.y;
            size += 1;
            last = next;
        }
    }
    return line_through(centre, sum, xx, xy, yy, size);
}

// Write the lines of all points of a scan.
void fit_scan(global const real4 *point, const int count, const int reach, const int most, const real ratio,
              const real slack, const real width, const real gap, global real4 *line) {
    for (int k = 0; k < count; ++k) line[k] = line_at(point, count, k, reach, most, ratio, slack, width, gap);
}

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
