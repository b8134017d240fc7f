"""Scan matching by point-to-line ICP with exact nearest points.

The points of a scan are sorted by bearing. Kernels search outwards from the bearing of a place, until no point farther
in bearing can be nearer; the reference compares all points.

Lines: see lines.py, and Censi (2008), "An ICP variant using a point-to-line metric". Weights: Cauchy's while the scale
shrinks, then Geman and McClure's, ``(1 / (1 + (e / c)^2))^2``.
"""

from __future__ import annotations

import numpy as np

from gpusense.interface import structs
from gpusense.interface.constants import MATCH_RESULT
from gpusense.reference.icp_step import FULL_TURN, MATCH_BLOCKS, bearing_of, block_squares, points_before, solve

# Weight in the score of a point that the other scan did not see; a point that disagrees has weight 1.
UNSEEN = 0.13


def nearest_point(point: np.ndarray, skip: int, place: np.ndarray, squared: float) -> np.ndarray:
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


def match_scans(
    flags: frozenset[str], point: np.ndarray, start: np.ndarray, line: np.ndarray, pair: np.ndarray, guess: np.ndarray,
    result: np.ndarray, scans: int, points: int, pairs: int, starts: int, rules: structs.MatchRules,
) -> None:  # fmt: skip
    """Match pairs of scans (reference, second scan) from guesses (x, y, theta).

    A guess is the pose of the second scan in the reference's frame. Every ``stride``-th point and every ``skip``-th of
    the reference take part until capture radius and scale have shrunk, with ``thin`` also afterwards. With ``one_way``
    the reference's points do not count in the score. A result is the pose (3), the score, iterations, whether the last
    step was below ten tolerances, the information (6), its part that is due to errors of the lines (6), pairs, sum of
    weights, weighted sum of squared errors, points that the other scan should see, points through which it saw, points
    that it did not see, and for blocks of 1, 2, 4 to 128 successive points the sum of squares of the blocks' sums of
    weighted errors (8), 0 with ``thin``; the last step (3).
    """
    out = result[: MATCH_RESULT * pairs * starts].reshape(-1, MATCH_RESULT)
    upper = np.triu_indices(3)
    for n in range(pairs * starts):
        first, second = (slice(start[scan], start[scan + 1]) for scan in pair[n // starts])
        one, other, lines = point[first], point[second], line[first]
        refined = _refine(one, other, lines, guess[n, :3], rules)
        pose, iteration, calm, information, doubt, numbers, squares, moved = refined
        both = np.zeros(4, point.dtype)
        if len(one) and len(other):
            (x, y), c, s = pose[:2], np.cos(pose[2]), np.sin(pose[2])
            inverse = np.array([-c * x - s * y, s * x - c * y, c, -s])
            step, skip, near, gap = rules.score_stride, rules.skip if rules.thin else 1, rules.near, rules.gap
            both += agreement(one, lines, other, step, skip, np.array([x, y, c, s]), near, gap)
            if not rules.one_way:
                both += agreement(other, line[second], one, step, skip, inverse, near, gap)
        everything = both[1] + both[2] + UNSEEN * both[3]
        out[n, :3] = pose
        out[n, 3] = (both[0] - 0.5 * both[2]) / everything if everything > 0 else 0
        out[n, 4:6] = iteration, calm
        out[n, 6:12], out[n, 12:18] = information[upper], doubt[upper]
        out[n, 18:] = numbers[2], numbers[0], numbers[1], *both[1:], *squares, *moved


def _refine(
    one: np.ndarray, other: np.ndarray, lines: np.ndarray, guess: np.ndarray, rules: structs.MatchRules
) -> tuple[np.ndarray, int, bool, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return pose, iterations, whether its last step was small, the sums of the last iteration, and that step."""
    real, pose = one.dtype.type, guess.copy()
    capture, scale = real(rules.capture), real(rules.scale)
    information = doubt = np.zeros((3, 3), real)
    numbers, iteration, settled, calm = np.zeros(3, real), 0, False, False
    squares, moved = np.zeros(MATCH_BLOCKS, real), np.zeros(3, real)
    while iteration < rules.iterations and not settled and len(one):
        last = bool(capture <= rules.least_capture and scale <= rules.least_scale)
        full = last and not rules.thin
        p = other[:: 1 if full else rules.stride]
        c, s = np.cos(pose[2]), np.sin(pose[2])
        arm = np.stack([c * p[:, 0] - s * p[:, 1], s * p[:, 0] + c * p[:, 1]], axis=1)
        place = arm + pose[:2]
        near = nearest_point(one, 1 if full else rules.skip, place, capture * capture)
        used = (near >= 0) & (lines[near, 3] > 0)
        pull = np.zeros(len(p), real)
        information, gradient, doubt, numbers, pull[used] = add_pairing(
            lines[near[used]], place[used], arm[used], scale, last
        )
        squares = block_squares(pull) if full else 0 * squares
        iteration += 1
        step = solve(information, gradient)
        if step is None:
            break
        length, most = np.hypot(step[0], step[1]), real(0.5) * real(rules.capture)
        if length > most:
            step[:2] *= most / length
        step[2] = np.clip(step[2], real(-0.3), real(0.3))
        moved = step
        pose = pose + step
        change = max(length, abs(step[2]))
        settled = bool(last and change < rules.tolerance)
        calm = bool(last and change < 10 * rules.tolerance)
        quiet = length < real(0.1) * scale and abs(step[2]) < real(0.03) * scale
        factor = real(rules.shrink) ** (2 if quiet and not last else 1)
        capture, scale = max(capture * factor, rules.least_capture), max(scale * factor, rules.least_scale)
    return pose, iteration, calm, information, doubt, numbers, squares, moved
