"""A pair of scans, from their readings: noise, points and lines, for match_scans of icp.py."""

import warp as wp

from .line_fit import fit_scan
from .pair_steps import level_of, noise_of, place_points
from .prelude import kernel
from .types import real


@kernel
def place_pair(
    reading, beam, weight, level, work, point, line, start, pair, summary, beams, places, padded, step, nearest,
    farthest, levels, assumed, coarse, strides, reach, most, ratio, width, gap,
):  # fmt: skip
    """Place two scans of one scanner, a reference and a second one."""
    item = wp.tid()
    if item > 0:
        return
    one = noise_of(reading, 0, weight, places, padded, step, nearest, farthest, work)
    other = noise_of(reading, beams, weight, places, padded, step, nearest, farthest, work)
    first, squares = place_points(reading, 0, beam, beams, nearest, farthest, point, 0)
    second, second_squares = place_points(reading, beams, beam, beams, nearest, farthest, point, first)
    chosen = level_of(wp.max(one, other), level, levels, assumed)
    slack = real(level[2 * chosen + 1])
    fit_scan(point, 0, first, reach, most, ratio, slack, width, gap, line)
    fit_scan(point, first, second, reach, most, ratio, slack, width, gap, line)
    start[0] = 0
    start[1] = first
    start[2] = first + second
    pair[0] = 0
    pair[1] = 1
    pair[2] = strides * chosen + wp.min(wp.max(second // coarse, 1), strides) - 1
    summary[0] = wp.float64(chosen)
    summary[1] = wp.float64(first)
    summary[2] = wp.float64(second)
    summary[3] = squares
    summary[4] = second_squares
