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
    end, heading, start, first, image, point, folded, folded_image, items, turns, period, step, offset
):  # fmt: skip
    """Place the end points of a scan at a heading in cells of the tables, and in cells and images of a folded table.
    One work-item takes an item.
    """
    item = wp.tid()
    if item >= items:
        return
    scan = item // turns
    begin = first[item]
    side = period // step
    ends = first[scan * turns] // turns
    cosine = heading[2 * item]
    sine = heading[2 * item + 1]
    start_x = start[2 * scan]
    start_y = start[2 * scan + 1]
    for k in range(begin, first[item + 1]):
        x = end[2 * (ends + k - begin)]
        y = end[2 * (ends + k - begin) + 1]
        across = cosine * x - sine * y
        along = sine * x + cosine * y
        cell = wp.vec2i(int(wp.floor(start_x + across)), int(wp.floor(start_y + along)))
        whole = wp.vec2i(floored(cell.x + offset, period), floored(cell.y + offset, period))
        col = (cell.x + offset - whole.x * period) // step
        row = (cell.y + offset - whole.y * period) // step
        point[k] = cell
        folded[k] = whole
        folded_image[k] = (image[k] * side + row) * side + col


def make(name, flags):
    """Return a kernel of the file; no flag changes one."""
    return globals()[name]
