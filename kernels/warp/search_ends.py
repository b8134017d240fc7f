"""End points of scans at all headings, as cells of tables of scores; see search.py."""

import warp as wp

from .prelude import kernel


@wp.func
def floored(number: wp.int32, divisor: wp.int32):
    """Return the quotient of integers, rounded down."""
    quotient = number // divisor
    if quotient * divisor > number:
        quotient = quotient - 1
    return quotient


@kernel()
def place_ends(
    end, heading, start, first, image, point, run, run_image, weight, runs, items, turns, period, step, offset
):  # fmt: skip
    """Place the end points of a scan at a heading: the cells of points, and runs of neighbouring points of the same
    cell of a folded table, by 64 at most. One work-item takes an item.
    """
    item = wp.tid()
    if item >= items:
        return
    scan = item // turns
    begin = first[item]
    last = first[item + 1]
    side = period // step
    ends = first[scan * turns] // turns
    cosine = heading[2 * item]
    sine = heading[2 * item + 1]
    start_x = start[2 * scan]
    start_y = start[2 * scan + 1]
    made = begin - 1
    for k in range(begin, last):
        x = end[2 * (ends + k - begin)]
        y = end[2 * (ends + k - begin) + 1]
        across = cosine * x - sine * y
        along = sine * x + cosine * y
        cell = wp.vec2i(int(wp.floor(start_x + across)), int(wp.floor(start_y + along)))
        point[k] = cell
        folded = wp.vec2i(floored(cell.x + offset, period), floored(cell.y + offset, period))
        col = (cell.x + offset - folded.x * period) // step
        row = (cell.y + offset - folded.y * period) // step
        chosen = (image[k] * side + row) * side + col
        same = int(0)
        if (k - begin) % 64 > 0:
            if run[made].x == folded.x and run[made].y == folded.y and run_image[made] == chosen:
                same = 1
        if same == 1:
            weight[made] = weight[made] + 1
        else:
            made = made + 1
            run[made] = folded
            run_image[made] = chosen
            weight[made] = 1
    runs[item] = made + 1 - begin


def make(name, flags):
    """Return a kernel of the file; no flag changes one."""
    return globals()[name]
