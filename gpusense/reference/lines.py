"""Lines through the points of scans, for point-to-line ICP; see line_fit.py."""

from __future__ import annotations

import numpy as np

from gpusense.reference.line_fit import fit_scan


def fit_lines(
    flags: frozenset[str], point: np.ndarray, start: np.ndarray, which: np.ndarray, line: np.ndarray, scans: int,
    points: int, chosen: int, reach: int, most: int, ratio: float, slack: float, width: float, gap: float,
) -> None:  # fmt: skip
    """Fit a line to each point of the chosen scans and ``reach`` neighbours on either side.

    Up to ``most`` neighbours within a distance of ``width`` take part. Each lies within ``slack`` plus ``ratio`` times
    its range of the previous one, and within ``gap`` of it in bearing. A line is a unit normal, an offset, and 1 / (sum
    of squared distances along the line). A point without neighbours has a line perpendicular to its beam, -1 in place
    of that sum, and no pairs.
    """
    for scan in which[:chosen]:
        mine = slice(start[scan], start[scan + 1])
        line[mine] = fit_scan(point[mine], reach, most, ratio, slack, width, gap)
