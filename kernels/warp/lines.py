"""Lines through the points of scans, for point-to-line ICP; see line_fit.py."""

import functools

import warp as wp

from . import line_fit
from .prelude import kernel


@functools.cache
def make(name, flags):
    """Make a kernel of the file for a set of flags."""
    line_at = line_fit.functions(flags).line_at

    @kernel(flags)
    def fit_lines(point, start, which, line, scans, points, chosen, reach, most, ratio, slack, width, gap):
        """Fit a line to each point and reach neighbours on either side, up to most within a distance of width, none of
        them farther from the last one than slack plus ratio times its range, nor than gap in bearing: unit normal,
        offset, and 1 / (sum of squared distances along the line). A point without neighbours has a line
        perpendicular to its beam, -1 in place of that sum, and no pairs. One work-item takes a point of a chosen
        scan.
        """
        row, k = wp.tid()
        if row >= chosen:
            return
        scan = which[row]
        first = start[scan]
        count = start[scan + 1] - first
        if k >= count:
            return
        line[first + k] = line_at(point, first, count, k, reach, most, ratio, slack, width, gap)

    return locals()[name]
