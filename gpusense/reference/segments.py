"""Straight segments of scans: pieces of the sequence of points that a line explains up to the noise of ranges.

On a line the inverse range is ``a cos(bearing) + b sin(bearing)``, linear in (a, b). Squared residuals, weighted by
range^2 / sigma, are range residuals in standard deviations; their sum is the cost. A scan is split where two lines
lower the cost most, until no split lowers it by ``penalty``; neighbours are merged where a single line costs less
than ``penalty`` more (split and merge, Pavlidis and Horowitz 1974), and ends are moved to where both lines together
cost least. Lines are then fitted to ranges by Gauss-Newton steps for maximum likelihood.
"""

from __future__ import annotations

import numpy as np

from gpusense.interface.constants import LINE_NUMBERS

# Passes of merging and of moving ends; Gauss-Newton steps of a line.
PASSES, STEPS = 2, 5
# A segment with a larger cost per point is split at its best point, even if a single split does not pay.
POOR = 3.0
# Rows count as parallel up to this sine.
PARALLEL = 1e-6
# Splits whose costs differ by less than this share, which exceeds float32 rounding, are tied: the first counts.
TIED = 3e-7


def middle_of_three(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Return the median of three numbers."""
    result: np.ndarray = np.maximum(np.minimum(a, b), np.minimum(np.maximum(a, b), c))
    return result


def weight_at(point: np.ndarray, i: int, first: int, last: int, sigma: float) -> np.ndarray:
    """Return the weights of the rows (x, y, 1) of points i to last; ranges are medians of three neighbours."""
    r = point[first:last, 3].astype(np.float64)
    before, after = np.append(r[:1], r[:-1]), np.append(r[1:], r[-1:])
    weight: np.ndarray = middle_of_three(before, r, after)[i - first :] ** 2 / (sigma * r[i - first :])
    return weight


def running_costs(rows: np.ndarray) -> np.ndarray:
    """Return the costs of the first 1, 2, ... of some rows (n, 3)."""
    a, b, v = rows.T
    aa, ab, bb, av, bv, vv = (np.cumsum(value) for value in (a * a, a * b, b * b, a * v, b * v, v * v))
    inner = bb - ab * ab / aa
    across = bv - ab * av / aa
    cost = np.maximum(vv - av * av / aa - np.where(inner > PARALLEL * PARALLEL * bb, across * across / inner, 0), 0)
    cost[0] = 0
    result: np.ndarray = np.where(np.isfinite(cost), cost, 0)
    return result


def rows_of(point: np.ndarray, first: int, last: int, sigma: float) -> np.ndarray:
    """Return the weighted rows (n, 3) of points."""
    mine = point[first:last].astype(np.float64)
    weight = weight_at(point, first, first, last, sigma)
    return weight[:, None] * np.column_stack([mine[:, :2], np.ones(len(mine))])


def cost_of(point: np.ndarray, first: int, last: int, sigma: float) -> float:
    """Return the cost of a line through points first to last."""
    return float(running_costs(rows_of(point, first, last, sigma))[-1])


def best_split(point: np.ndarray, first: int, last: int, sigma: float, penalty: float) -> tuple[int, float, float]:
    """Return the first point of the second line of the best split, how much it saves, and the cost without it.

    The point is -1 if no split can lower the cost by ``penalty``.
    """
    rows = rows_of(point, first, last, sigma)
    left = running_costs(rows)
    total = float(left[-1])
    if total <= penalty:
        return -1, 0.0, total
    right = running_costs(rows[::-1])[::-1]
    gain = total - left[:-1] - right[1:]
    best = int((gain >= gain.max() - TIED * (1e5 + total)).argmax())
    return first + best + 1, float(gain[best]), total


def is_apart(point: np.ndarray, k: int, gap: float) -> bool:
    """Return whether something may be hidden between point k and the one before."""
    return bool(point[k, 2] - point[k - 1, 2] > gap)


def split_scan(
    point: np.ndarray, first: int, last: int, stop: np.ndarray, sigma: float, penalty: float, gap: float
) -> None:
    """Split a scan: each segment's first point gets its end, all other points -1."""
    stop[first:last] = -1
    begin = first
    for k in range(first + 1, last + 1):
        if k == last or is_apart(point, k, gap):
            stop[begin] = k
            begin = k
    i = first
    while i < last:
        k, gain, total = best_split(point, i, stop[i], sigma, penalty)
        if k >= 0 and (gain > penalty or total > POOR * (stop[i] - i) + penalty):
            stop[k] = stop[i]
            stop[i] = k
        else:
            i = stop[i]


def merge_segments(
    point: np.ndarray, first: int, last: int, stop: np.ndarray, sigma: float, penalty: float, gap: float
) -> None:
    """Merge neighbours that a single line fits at an extra cost below ``penalty``."""
    i = first
    while i < last and stop[i] < last:
        j = stop[i]
        whole = penalty
        if not is_apart(point, j, gap):
            whole = cost_of(point, i, stop[j], sigma) - cost_of(point, i, j, sigma) - cost_of(point, j, stop[j], sigma)
        if whole < penalty:
            stop[i] = stop[j]
            stop[j] = -1
        else:
            i = j


def move_ends(
    point: np.ndarray, first: int, last: int, stop: np.ndarray, sigma: float, penalty: float, gap: float
) -> None:
    """Move the ends between neighbours to where both lines cost least."""
    i = first
    while i < last and stop[i] < last:
        j = stop[i]
        end = stop[j]
        k = -1
        if not is_apart(point, j, gap):
            k, _, _ = best_split(point, i, end, sigma, penalty)
        if k >= 0:
            stop[j] = -1
            stop[k] = end
            stop[i] = k
            j = k
        i = j


def fit_line(mine: np.ndarray, sigma: float) -> np.ndarray:
    """Return a, b, the triangular root of the information about (a, b), and the cost of a line.

    The cost is -1 where no line fits, and all are 0 for two points.
    """
    if len(mine) < 3:
        return np.zeros(LINE_NUMBERS)
    x, y, r = (mine[:, i].astype(np.float64) for i in (0, 1, 3))
    c, s = x / r, y / r
    rows = (r * r / sigma)[:, None] * np.column_stack([c, s, 1 / r])
    a, b = _solve(rows)
    for _ in range(STEPS):
        expected = 1 / (a * c + b * s)
        if not (expected > 0).all():
            return np.array([a, b, 0, 0, 0, -1.0])
        weight = -expected * expected / sigma
        step = _solve(np.column_stack([weight * c, weight * s, (r - expected) / sigma]))
        a, b = a + step[0], b + step[1]
    expected = 1 / (a * c + b * s)
    weight = expected * expected / sigma
    cc, cs, ss = (weight * c) @ (weight * c), (weight * c) @ (weight * s), (weight * s) @ (weight * s)
    r11 = np.sqrt(cc)
    r12 = cs / r11
    cost = float((((r - expected) / sigma) ** 2).sum()) if (expected > 0).all() else -1.0
    return np.array([a, b, r11, r12, np.sqrt(max(ss - r12 * r12, 0)), cost])


def _solve(rows: np.ndarray) -> np.ndarray:
    """Return the least-squares solution of rows (n, 3)."""
    q, r = np.linalg.qr(rows[:, :2])
    z = q.T @ rows[:, 2]
    second = z[1] / r[1, 1] if r[1, 1] != 0 else 0.0
    return np.array([(z[0] - r[0, 1] * second) / r[0, 0], second])


def split_scans(flags, point, start, noise, cost, stop, scans, points, penalty, gap):
    """Split scans into segments: ``stop`` is the end of the segment that begins at a point, -1 at all other points."""
    for scan in range(scans):
        first, last, sigma = int(start[scan]), int(start[scan + 1]), float(noise[scan])
        if last == first:
            continue
        split_scan(point, first, last, stop, sigma, penalty, gap)
        for _ in range(PASSES):
            merge_segments(point, first, last, stop, sigma, penalty, gap)
            move_ends(point, first, last, stop, sigma, penalty, gap)
        merge_segments(point, first, last, stop, sigma, penalty, gap)


def fit_segments(flags, point, start, noise, part, scan, line, scans, points, parts):
    """Fit lines to parts of scans: first point and number of points, which may wrap around to the first point."""
    for k in range(parts):
        begin, end = start[scan[k]], start[scan[k] + 1]
        index = begin + (part[k, 0] - begin + np.arange(part[k, 1])) % (end - begin)
        line[LINE_NUMBERS * k : LINE_NUMBERS * (k + 1)] = fit_line(point[index], float(noise[scan[k]]))
