// Lines through the points of a scan and their neighbours, for point-to-line ICP: total least squares.

#define WHOLE_TURN ((real)6.283185307179586)

// Return the line through a point and its neighbours, a unit normal, an offset, and 1 / (sum of squared distances along the
// line), from sums of the neighbours' coordinates relative to the point and of their products. A point without
// neighbours gets the line perpendicular to its beam, and -1 instead of the sum.
real4 line_through(const real4 centre, const real2 sum, const real xx, const real xy, const real yy, const int size) {
    const real2 mean = sum / (real)size;
    const real a = xx - size * mean.x * mean.x, b = xy - size * mean.x * mean.y, d = yy - size * mean.y * mean.y;
    const real middle = (real)0.5 * (a - d), root = sqrt(middle * middle + b * b), length = (real)0.5 * (a + d) + root;
    real2 along = middle >= 0 ? (real2)(middle + root, b) : (real2)(b, root - middle);
    real size_along = sqrt(along.x * along.x + along.y * along.y);
    const int is_line = length > 0 && size_along > 0;
    if (!is_line) {
        along = (real2)(-centre.y, centre.x);
        size_along = centre.w;
    }
    const real2 normal = (real2)(-along.y / size_along, along.x / size_along);
    const real offset = normal.x * (centre.x + mean.x) + normal.y * (centre.y + mean.y);
    return (real4)(normal.x, normal.y, offset, is_line ? 1 / length : -1);
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
