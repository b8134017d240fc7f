"""Lines through the points of a scan and their neighbours, for point-to-line ICP: total least squares."""

from __future__ import annotations

import numpy as np

WHOLE_TURN = 6.283185307179586


def line_through(point: np.ndarray, sums: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Return the lines (N, 4) through points (N, 4) and their neighbours; see ``fit_lines``.

    ``sums``: (5, N) sums of the neighbours' x, y, x x, x y and y y relative to the points; ``size``: (N,) their number.
    """
    mean_x, mean_y = sums[0] / size, sums[1] / size
    a, b = sums[2] - size * mean_x * mean_x, sums[3] - size * mean_x * mean_y
    d = sums[4] - size * mean_y * mean_y
    middle = (a - d) / 2
    root = np.sqrt(middle * middle + b * b)
    length = (a + d) / 2 + root
    along = np.where(middle >= 0, [middle + root, b], [b, root - middle])
    is_line = (length > 0) & ((along**2).sum(axis=0) > 0)
    along = np.where(is_line, along, [-point[:, 1], point[:, 0]])
    along = along / np.where(is_line, np.hypot(*along), point[:, 3])
    offset = -along[1] * (point[:, 0] + mean_x) + along[0] * (point[:, 1] + mean_y)
    doubt = np.where(is_line, 1 / np.where(is_line, length, 1), -1)
    return np.stack([-along[1], along[0], offset, doubt], axis=1)


def fit_scan(
    point: np.ndarray, reach: int, most: int, ratio: float, slack: float, width: float, gap: float
) -> np.ndarray:
    """Return the lines (N, 4) through the points (N, 4) of a scan and their neighbours; see ``fit_lines``."""
    count = len(point)
    sums, size = np.zeros((5, count), point.dtype), np.ones(count, point.dtype)
    for direction in (-1, 1):
        last, joined = point, np.ones(count, bool)
        for j in range(1, most + 1):
            if 2 * j >= count:
                break
            following = point[(np.arange(count) + direction * j) % count]
            between = following[:, :2] - last[:, :2]
            joined = joined & ((between**2).sum(axis=1) <= (slack + ratio * last[:, 3]) ** 2)
            turn = np.abs(following[:, 2] - last[:, 2])
            joined = joined & (np.minimum(turn, point.dtype.type(WHOLE_TURN) - turn) <= gap)
            if j > reach:
                joined = joined & (((following[:, :2] - point[:, :2]) ** 2).sum(axis=1) <= width * width)
            x, y = (np.where(joined, following[:, i] - point[:, i], 0) for i in (0, 1))
            sums += np.stack([x, y, x * x, x * y, y * y])
            size += joined
            last = following
    return line_through(point, sums, size)


def fit_lines(flags, point, start, which, line, scans, points, chosen, reach, most, ratio, slack, width, gap):
    """Fit a line to each point of the chosen scans and ``reach`` neighbours on either side.

    Up to ``most`` neighbours within a distance of ``width`` take part. Each lies within ``slack`` plus ``ratio`` times
    its range of the previous one, and within ``gap`` of it in bearing. A line is a unit normal, an offset, and 1 / (sum
    of squared distances along the line). A point without neighbours has a line perpendicular to its beam, -1 in place
    of that sum, and no pairs.
    """
    for scan in which[:chosen]:
        mine = slice(start[scan], start[scan + 1])
        line[mine] = fit_scan(point[mine], reach, most, ratio, slack, width, gap)
