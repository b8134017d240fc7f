"""Pairs of point-to-line ICP: nearest points, sums over pairs, and the agreement of two scans.

The nearest point is exact. The points of a scan are sorted by bearing: kernels search outwards from the bearing of a
place, until no point farther in bearing can be nearer. The reference compares all points.

Lines: see line_fit.py, and Censi (2008), "An ICP variant using a point-to-line metric". Weights: Cauchy's while the
scale shrinks, then Geman and McClure's, ``(1 / (1 + (e / c)^2))^2``.
"""

from __future__ import annotations

import numpy as np

from gpusense.reference.icp_step import FULL_TURN, MATCH_BLOCKS, bearing_of, block_squares, points_before


def nearest_point(point: np.ndarray, skip: int, place: np.ndarray, squared: float | np.floating) -> np.ndarray:
    """Return the nearest of every skip-th point that are nearer than the square root of ``squared``, -1 without one."""
    d = point[None, ::skip, :2] - place[:, None]
    distance = d[..., 0] * d[..., 0] + d[..., 1] * d[..., 1]
    which = distance.argmin(axis=1)
    return np.where(distance[np.arange(len(place)), which] < squared, skip * which, -1)


def add_pairing(
    line: np.ndarray, place: np.ndarray, arm: np.ndarray, scale: np.floating, last: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return sums over pairs of a line and a place: information, gradient, errors of the lines, and three numbers.

    The numbers are the sum of weights, the weighted sum of squared errors, and the number of pairs. The weighted error
    of each pair comes last. ``arm`` is the place relative to the second scan's origin.
    """
    x, y = line[:, 0], line[:, 1]
    error = x * place[:, 0] + y * place[:, 1] - line[:, 2]
    weight = 1 / (1 + (error / scale) ** 2)
    if last:
        weight = weight * weight
    jacobian = np.stack([x, y, y * arm[:, 0] - x * arm[:, 1]])
    across = np.stack([-y, x, x * arm[:, 0] + y * arm[:, 1]])
    information = (weight * jacobian) @ jacobian.T
    doubt = (weight * line[:, 3] * across) @ across.T
    return (
        information, -(jacobian @ (weight * error)), doubt,
        np.array([weight.sum(), (weight * error * error).sum(), len(error)], line.dtype), weight * error,
    )  # fmt: skip


def agreement(
    point: np.ndarray, line: np.ndarray, other: np.ndarray, stride: int, skip: int, pose: np.ndarray, near: float,
    gap: float,
) -> np.ndarray:  # fmt: skip
    """Return how well every stride-th point of one scan agrees with every skip-th point of another scan.

    The four numbers are the sum of agreements, points that the other scan should see, points through which it saw, and
    points that it did not see. ``pose`` is (x, y, cos, sin).
    """
    p = other[::stride]
    x = pose[2] * p[:, 0] - pose[3] * p[:, 1] + pose[0]
    y = pose[3] * p[:, 0] + pose[2] * p[:, 1] + pose[1]
    place = np.stack([x, y], axis=1)
    which = nearest_point(point, skip, place, near * near)
    at = line[which]
    ratio = (at[:, 0] * x + at[:, 1] * y - at[:, 2]) / (near / 3)
    ahead, count = points_before(point, bearing_of(place)), len(point)
    low, high = point[np.where(ahead > 0, ahead - 1, count - 1)], point[np.where(ahead < count, ahead, 0)]
    between = high[:, 2] - low[:, 2]
    between = np.where(between < 0, between + point.dtype.type(FULL_TURN), between)
    range_ = np.minimum(low[:, 3], high[:, 3])
    paired, through = which >= 0, (between <= gap) & (x * x + y * y < range_ * range_)
    agreements = np.where(paired, 1 / (1 + ratio * ratio), 0).sum()
    counts = [np.count_nonzero(mask) for mask in (paired, ~paired & through, ~paired & ~through)]
    return np.array([agreements, *counts], point.dtype)


def sum_pairs(
    point: np.ndarray, line: np.ndarray, other: np.ndarray, stride: int, skip: int, pose: np.ndarray,
    capture: np.floating, scale: np.floating, last: bool, full: bool,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """Return the four sums of ``add_pairing`` over a scan's points, and the squares of blocks, 0 unless ``full``.

    ``pose`` is (x, y, cos, sin).
    """
    p, (c, s) = other[::stride], pose[2:]
    arm = np.stack([c * p[:, 0] - s * p[:, 1], s * p[:, 0] + c * p[:, 1]], axis=1)
    place = arm + pose[:2]
    near = nearest_point(point, skip, place, capture * capture)
    used = (near >= 0) & (line[near, 3] > 0)
    pull = np.zeros(len(p), point.dtype)
    *sums, pull[used] = add_pairing(line[near[used]], place[used], arm[used], scale, last)
    information, gradient, doubt, numbers = sums
    squares = block_squares(pull) if full else np.zeros(MATCH_BLOCKS, point.dtype)
    return information, gradient, doubt, numbers, squares
