"""End points of scans at all headings, as cells of tables of scores; see search.py."""

import warp as wp

from .prelude import kernel


@wp.func
def periods(cell: wp.int32, stride: wp.int32, level: wp.int32):
    """Return a cell divided by stride * 2^level, rounded down."""
    number = cell >> level
    quotient = number // stride
    if quotient * stride > number:
        quotient = quotient - 1
    return quotient


@kernel
def place_ends(
    end, heading, start, first, image, point, folded, bound_image, quarter_image, items, turns, stride, level,
    step_level, offset, workers,
    size, bound_size, quarter_size,
):  # fmt: skip
    """Place the end points of a scan at a heading in cells of tables, and in cells and images of folded tables."""
    item, n = wp.tid()
    if item >= items or n >= workers:
        return
    scan = item // turns
    side = stride << (level - step_level)
    period = stride << level
    cosine = heading[2 * item]
    sine = heading[2 * item + 1]
    begin = first[item]
    ends = 2 * (first[scan * turns] // turns)
    for k in range(begin + n, first[item + 1], workers):
        m = ends + 2 * (k - begin)
        across = cosine * end[m] - sine * end[m + 1]
        along = sine * end[m] + cosine * end[m + 1]
        cell = wp.vec2i(int(wp.floor(start[2 * scan] + across)), int(wp.floor(start[2 * scan + 1] + along)))
        x = cell.x + offset
        y = cell.y + offset
        whole = wp.vec2i(periods(x, stride, level), periods(y, stride, level))
        col = x - whole.x * period
        row = y - whole.y * period
        point[k] = cell
        folded[k] = whole
        table = image[k]
        image[k] = size * table
        bound_image[k] = bound_size * ((table * side + (row >> step_level)) * side + (col >> step_level))
        quarter_image[k] = quarter_size * ((table * period + row) * period + col)
