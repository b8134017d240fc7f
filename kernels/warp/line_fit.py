"""Lines through the points of a scan and their neighbours, for point-to-line ICP: total least squares."""

import warp as wp

from .prelude import kernel
from .types import real, vec2, vec4

ZERO, ONE, HALF, MISSING = real(0.0), real(1.0), real(0.5), real(-1.0)
WHOLE_TURN = real(6.283185307179586)


@wp.func
def line_through(centre: vec4, total: vec2, xx: real, xy: real, yy: real, weight: real):
    """Return the line through a point and its neighbours from sums of their coordinates relative to the point."""
    mean_x = total.x / weight
    mean_y = total.y / weight
    a = xx - weight * mean_x * mean_x
    b = xy - weight * mean_x * mean_y
    d = yy - weight * mean_y * mean_y
    middle = HALF * (a - d)
    root = wp.sqrt(middle * middle + b * b)
    length = HALF * (a + d) + root
    along_x = b
    along_y = root - middle
    if middle >= ZERO:
        along_x = middle + root
        along_y = b
    size_along = wp.sqrt(along_x * along_x + along_y * along_y)
    doubt = MISSING
    if length > ZERO and size_along > ZERO:
        doubt = ONE / length
    else:
        along_x = -centre.y
        along_y = centre.x
        size_along = centre.w
    normal_x = -along_y / size_along
    normal_y = along_x / size_along
    offset = normal_x * (centre.x + mean_x) + normal_y * (centre.y + mean_y)
    return vec4(normal_x, normal_y, offset, doubt)


@wp.func
def line_at(
    point: wp.array(dtype=vec4), first: wp.int32, count: wp.int32, k: wp.int32, reach: wp.int32, most: wp.int32,
    ratio: real, slack: real, width: real, gap: real,
):  # fmt: skip
    """Return the line through the k-th point of a scan and at most reach neighbours on either side."""
    centre = point[first + k]
    sum_x = real(0.0)
    sum_y = real(0.0)
    xx = real(0.0)
    xy = real(0.0)
    yy = real(0.0)
    size = int(1)
    for side in range(2):
        direction = 2 * side - 1
        last = centre
        j = int(1)
        while j <= most and 2 * j < count:
            i = k + direction * j
            if i >= count:
                i -= count
            if i < 0:
                i += count
            following = point[first + i]
            x = following.x - last.x
            y = following.y - last.y
            farthest = slack + ratio * last.w
            dx = following.x - centre.x
            dy = following.y - centre.y
            turn = wp.abs(following.z - last.z)
            turn = wp.min(turn, WHOLE_TURN - turn)
            too_far = x * x + y * y > farthest * farthest or turn > gap
            if too_far or (j > reach and dx * dx + dy * dy > width * width):
                j = count
            else:
                sum_x += dx
                sum_y += dy
                xx += dx * dx
                xy += dx * dy
                yy += dy * dy
                size += 1
                last = following
            j += 1
    return line_through(centre, vec2(sum_x, sum_y), xx, xy, yy, real(size))


@wp.func
def fit_scan(
    point: wp.array(dtype=vec4), first: wp.int32, count: wp.int32, reach: wp.int32, most: wp.int32, ratio: real,
    slack: real, width: real, gap: real, line: wp.array(dtype=vec4),
):  # fmt: skip
    """Write the lines of all points of a scan."""
    for k in range(count):
        line[first + k] = line_at(point, first, count, k, reach, most, ratio, slack, width, gap)


@kernel
def fit_lines(point, start, which, line, scans, points, chosen, reach, most, ratio, slack, width, gap):
    """Fit a line to each point and at most reach neighbours on either side."""
    row, k = wp.tid()
    if row >= chosen:
        return
    scan = which[row]
    first = start[scan]
    count = start[scan + 1] - first
    if k >= count:
        return
    line[first + k] = line_at(point, first, count, k, reach, most, ratio, slack, width, gap)
