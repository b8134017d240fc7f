"""Straight segments of scans: pieces of the sequence of points that a line explains up to the noise of ranges."""

import warp as wp

from gpusense.interface.constants import LINE_NUMBERS

from .prelude import kernel
from .types import real, vec4

# Passes of merging and of moving ends; Gauss-Newton steps of a line; numbers of a line.
PASSES, STEPS = 2, 5
# The triangular root of rows that were added (11, 12, right side 1, 22, right side 2), and the cost.
rows6 = wp.types.vector(length=6, dtype=real)
ZERO, ONE, MINUS_ONE = real(0.0), real(1.0), real(-1.0)
# A segment with a larger cost per point is split at its best point, even if a single split does not pay.
POOR = real(3.0)
# Rows count as parallel up to this sine. Splits whose costs differ by less than a share are tied.
PARALLEL, TIED, TIED_AT = real(1e-6), real(3e-7), real(1e5)
LAST_STEP = STEPS + 1


@wp.func
def middle_of_three(a: real, b: real, c: real):
    """Return the median of three numbers."""
    return wp.max(wp.min(a, b), wp.min(wp.max(a, b), c))


@wp.func
def weight_at(point: wp.array(dtype=vec4), i: wp.int32, first: wp.int32, last: wp.int32, sigma: real):
    """Return the weight of the row (x, y, 1) of point i; its range is the median of three neighbours."""
    r = point[i][3]
    middle = middle_of_three(point[wp.max(i - 1, first)][3], r, point[wp.min(i + 1, last - 1)][3])
    return middle * middle / (sigma * r)


@wp.func
def add_row(rows: rows6, first: real, second: real, right: real):
    """Return the rows with another row (a, b | v)."""
    a = first
    b = second
    v = right
    r11 = rows[0]
    r12 = rows[1]
    z1 = rows[2]
    r22 = rows[3]
    z2 = rows[4]
    size = wp.sqrt(r11 * r11 + a * a)
    largest = wp.abs(b) + wp.abs(r12)
    if size > ZERO:
        c = r11 / size
        s = a / size
        upper = r12
        side = z1
        r11 = size
        r12 = c * upper + s * b
        z1 = c * side + s * v
        b = c * b - s * upper
        v = c * v - s * side
    size = wp.sqrt(r22 * r22 + b * b)
    if size > PARALLEL * largest:
        c = r22 / size
        s = b / size
        side = z2
        r22 = size
        z2 = c * side + s * v
        v = c * v - s * side
    return rows6(r11, r12, z1, r22, z2, rows[5] + v * v)


@wp.func
def with_point(rows: rows6, point: wp.array(dtype=vec4), i: wp.int32, first: wp.int32, last: wp.int32, sigma: real):
    """Return the rows including a point's."""
    weight = weight_at(point, i, first, last, sigma)
    p = point[i]
    return add_row(rows, weight * p[0], weight * p[1], weight)


@wp.func
def cost_of(point: wp.array(dtype=vec4), first: wp.int32, last: wp.int32, sigma: real):
    """Return the cost of a line through points first to last."""
    rows = rows6()
    for i in range(first, last):
        rows = with_point(rows, point, i, first, last, sigma)
    return rows[5]


@wp.func
def best_split(
    point: wp.array(dtype=vec4), first: wp.int32, last: wp.int32, cost: wp.array(dtype=real), sigma: real,
    penalty: real,
):  # fmt: skip
    """Return the first point of the second line of the best split, the cost reduction, and the unsplit cost."""
    rows = rows6()
    for i in range(first, last):
        rows = with_point(rows, point, i, first, last, sigma)
        cost[i] = rows[5]
    total = rows[5]
    gain = real(0.0)
    best = int(-1)
    if total > penalty:
        rows = rows6()
        i = last - 1
        while i > first:
            rows = with_point(rows, point, i, first, last, sigma)
            # From here on cost[i] is the cost that a split before point i saves.
            lowered = total - cost[i - 1] - rows[5]
            cost[i] = lowered
            gain = wp.max(gain, lowered)
            i -= 1
        best = first + 1
        while best < last - 1 and cost[best] < gain - TIED * (TIED_AT + total):
            best += 1
        gain = cost[best]
    return best, gain, total


@wp.func
def is_apart(point: wp.array(dtype=vec4), k: wp.int32, gap: real):
    """Return whether something may be hidden between point k and the one before."""
    return point[k][2] - point[k - 1][2] > gap


@wp.func
def split_scan(
    point: wp.array(dtype=vec4), first: wp.int32, last: wp.int32, cost: wp.array(dtype=real),
    stop: wp.array(dtype=wp.int32), sigma: real, penalty: real, gap: real,
):  # fmt: skip
    """Split a scan: each segment's first point gets its end, all other points -1."""
    begin = int(first)
    for k in range(first + 1, last):
        stop[k] = -1
        if is_apart(point, k, gap):
            stop[begin] = k
            begin = k
    stop[begin] = last
    i = int(first)
    while i < last:
        end = stop[i]
        k, gain, total = best_split(point, i, end, cost, sigma, penalty)
        if k >= 0 and (gain > penalty or total > POOR * real(end - i) + penalty):
            stop[k] = end
            stop[i] = k
        else:
            i = end


@wp.func
def merge_segments(
    point: wp.array(dtype=vec4), first: wp.int32, last: wp.int32, stop: wp.array(dtype=wp.int32), sigma: real,
    penalty: real, gap: real,
):  # fmt: skip
    """Merge neighbours that a single line fits at an extra cost below penalty."""
    i = int(first)
    while i < last and stop[i] < last:
        j = stop[i]
        end = stop[j]
        whole = penalty
        if not is_apart(point, j, gap):
            whole = cost_of(point, i, end, sigma) - cost_of(point, i, j, sigma) - cost_of(point, j, end, sigma)
        if whole < penalty:
            stop[i] = end
            stop[j] = -1
        else:
            i = j


@wp.func
def move_ends(
    point: wp.array(dtype=vec4), first: wp.int32, last: wp.int32, cost: wp.array(dtype=real),
    stop: wp.array(dtype=wp.int32), sigma: real, penalty: real, gap: real,
):  # fmt: skip
    """Move the ends between neighbours to where both lines cost least."""
    i = int(first)
    while i < last and stop[i] < last:
        j = stop[i]
        end = stop[j]
        following = j
        if not is_apart(point, j, gap):
            k, _gain, _total = best_split(point, i, end, cost, sigma, penalty)
            if k >= 0:
                stop[j] = -1
                stop[k] = end
                stop[i] = k
                following = k
        i = following


@wp.func
def fit_line(
    point: wp.array(dtype=vec4), begin: wp.int32, size: wp.int32, first: wp.int32, count: wp.int32, sigma: real,
    line: wp.array(dtype=real), place: wp.int32,
):  # fmt: skip
    """Write a, b, the triangular root of their information, and the cost of a line; -1 where no line fits."""
    a = real(0.0)
    b = real(0.0)
    rows = rows6()
    cost = real(0.0)
    step = int(0)
    if count < 3:
        step = LAST_STEP + 1
    while step <= LAST_STEP:
        rows = rows6()
        cost = real(0.0)
        for k in range(count):
            p = point[begin + (first - begin + k) % size]
            c = p[0] / p[3]
            s = p[1] / p[3]
            if step == 0:
                weight = p[3] * p[3] / sigma
                rows = add_row(rows, weight * c, weight * s, weight / p[3])
            else:
                expected = ONE / (a * c + b * s)
                weight = expected * expected / sigma
                error = (p[3] - expected) / sigma
                if not (expected > ZERO):
                    cost = MINUS_ONE
                if cost >= ZERO:
                    cost += error * error
                rows = add_row(rows, MINUS_ONE * weight * c, MINUS_ONE * weight * s, error)
        if cost < ZERO:
            step = LAST_STEP
            rows = rows6()
        if step < LAST_STEP:
            second = real(0.0)
            if rows[3] != ZERO:
                second = rows[4] / rows[3]
            a += (rows[2] - rows[1] * second) / rows[0]
            b += second
        step += 1
    line[place] = a
    line[place + 1] = b
    line[place + 2] = rows[0]
    line[place + 3] = rows[1]
    line[place + 4] = rows[3]
    line[place + 5] = cost


@kernel
def split_scans(point, start, noise, cost, stop, scans, points, penalty, gap):
    """Split scans into segments: stop is the end of the segment that begins at a point, -1 at all other points."""
    scan = wp.tid()
    if scan >= scans:
        return
    first = start[scan]
    last = start[scan + 1]
    sigma = noise[scan]
    if last > first:
        split_scan(point, first, last, cost, stop, sigma, penalty, gap)
        for _turn in range(PASSES):
            merge_segments(point, first, last, stop, sigma, penalty, gap)
            move_ends(point, first, last, cost, stop, sigma, penalty, gap)
        merge_segments(point, first, last, stop, sigma, penalty, gap)


@kernel
def fit_segments(point, start, noise, part, scan, line, scans, points, parts):
    """Fit lines to parts of scans."""
    k = wp.tid()
    if k >= parts:
        return
    begin = start[scan[k]]
    size = start[scan[k] + 1] - begin
    fit_line(point, begin, size, part[k][0], part[k][1], noise[scan[k]], line, LINE_NUMBERS * k)
