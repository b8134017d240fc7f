"""A pair of scans, from their readings: noise, points and lines, for match_scans of icp.py."""

import numpy as np

from gpusense.reference.line_fit import fit_scan
from gpusense.reference.pair_steps import level_of, noise_of, place_points
from gpusense.reference.reading_class import is_hit


def place_pair(
    flags, reading, beam, weight, level, work, point, line, start, pair, summary, beams, places, padded, step,
    nearest, farthest, levels, assumed, coarse, strides, reach, most, ratio, width, gap,
):  # fmt: skip
    """Place two scans of one scanner, a reference and a second one: points of their hits by bearing, and lines.

    Lines are fitted for the pair's noise. A beam is its cosine and sine, its bearing in [0, 2 pi), and the place of its
    reading; beams come by bearing. Weights belong to the beams before and after each place, every ``step``-th beam but
    the ends. A level of noise is its largest noise, and the slack of its lines. The pair has the row of its rules,
    which depends on its level and on the stride of its second scan. The summary is its level, the points of both scans,
    and their sums of squared ranges.
    """
    readings = reading[: 2 * beams].reshape(2, beams)
    weights = weight[: 2 * places].reshape(places, 2)
    parts = tuple(slice(first, first + step * (places - 1) + 1, step) for first in (0, 1, 2))
    known = np.where(is_hit(readings, nearest, farthest), readings, np.nan)
    noise = noise_of(known, parts, weights[:, 0], weights[:, 1])
    chosen = level_of(float(np.fmax(*noise)), level.reshape(-1, 2)[:levels, 0], assumed)
    lines = reach, most, ratio, point.dtype.type(level[2 * chosen + 1]), width, gap
    start[0], summary[0] = 0, chosen
    for i, scan in enumerate(readings):
        points, squares = place_points(scan, beam[: 4 * beams].reshape(beams, 4), nearest, farthest, point.dtype)
        mine = slice(start[i], start[i] + len(points))
        point[mine], line[mine] = points, fit_scan(points, *lines)
        start[i + 1], summary[1 + i], summary[3 + i] = mine.stop, len(points), squares
    pair[:3] = 0, 1, strides * chosen + min(max(int(summary[2]) // coarse, 1), strides) - 1
