"""A ray on the grid and the walk along it, which all casters share.

Distances of boundaries are ``(k + a) * inv`` with an integer count k of boundaries; they are never accumulated. Every
operation is rounded as on devices, so float32 ranges have the same bits.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

TINY = 1e-30
# Abramowitz and Stegun 4.4.49 for the arc tangent, in turns.
_TURNS = (0.15913362, -0.05256880, 0.02867033, -0.01354934, 0.00331601)


@dataclass(frozen=True)
class Ray:
    """M rays: (2, M) directions of unit length in the grid's frame, and by axis their sign, size and inverse.

    ``a`` is the distance to the first boundary along each axis, in cells.
    """

    direction: np.ndarray
    step: np.ndarray
    speed: np.ndarray
    inv: np.ndarray
    a: np.ndarray


def off_grid(at: np.ndarray, rows: int, cols: int) -> np.ndarray:
    """Return whether cells, (2, M) columns and rows, lie outside the grid."""
    col, row = at
    return (col < 0) | (col >= cols) | (row < 0) | (row >= rows)


def ray_direction(pose: np.ndarray, ray: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit directions in the grid's frame: pose (..., 4) = (frac x, frac y, cos, sin) turned by ray (..., 2)."""
    cos, sin = pose[..., 2], pose[..., 3]
    dx = cos * ray[..., 0] - sin * ray[..., 1]
    dy = sin * ray[..., 0] + cos * ray[..., 1]
    zero = pose.dtype.type(0)
    return np.where(np.abs(dx) < TINY, zero, dx), np.where(np.abs(dy) < TINY, zero, dy)


def make_ray(pose: np.ndarray, ray: np.ndarray) -> Ray:
    """Make the rays of (M, 4) poses and (M, 2) beams."""
    direction = np.stack(ray_direction(pose, ray))
    ahead = direction >= 0
    speed = np.abs(direction)
    fraction = pose[:, :2].T
    return Ray(direction, np.where(ahead, 1, -1), speed, 1 / speed, np.where(ahead, 1 - fraction, fraction))


def crossed(t: np.ndarray, speed: np.ndarray, a: np.ndarray, inv: np.ndarray, until: np.ndarray | bool) -> np.ndarray:
    """Count the boundaries k = 0, 1, ... whose distance (k + a) * inv is below t, or with ``until`` at most t.

    Only the boundary nearest to the coordinate at t can be in doubt.
    """
    k = np.maximum(np.rint(t * speed - a), 0)
    here = (k + a) * inv
    return k + np.where(until, here <= t, here < t)


def start_walk(flags, r, cell, window, limit):
    """Return boundaries crossed (2, M) and distance (M,) at the ray's origin, or at the first cell inside the grid.

    The distance is limit where a ray from outside does not meet the grid before limit.
    """
    real = r.direction.dtype
    k, t = np.zeros(r.direction.shape, real), np.zeros(len(cell), real)
    if "ORIGINS_OUTSIDE" not in flags:
        return k, t
    origin, size = cell.T.astype(np.int64), np.array([[window.cols], [window.rows]])
    outside = off_grid(origin, window.rows, window.cols)
    ahead = np.maximum(np.where(r.step > 0, -origin, origin - (size - 1)), 0)
    entry = np.where(ahead > 0, ((ahead - 1).astype(real) + r.a) * r.inv, real.type(-1))
    when = np.maximum(entry[0], entry[1])
    enters = outside & (when >= 0) & (when < limit)
    by_x = entry[0] > entry[1]
    k_x = np.where(by_x, ahead[0], crossed(when, r.speed[0], r.a[0], r.inv[0], True))
    k_y = np.where(by_x, crossed(when, r.speed[1], r.a[1], r.inv[1], False), ahead[1])
    k[:, enters] = np.stack([k_x, k_y])[:, enters]
    at = origin[:, enters] + r.step[:, enters] * k[:, enters].astype(np.int64)
    enters[enters] = ~off_grid(at, window.rows, window.cols)
    t[outside] = limit
    t[enters] = when[enters]
    return k, t


def start_casts(flags, r, cell, window, limit):
    """Return the start of all walks, and the ranges that are known before any cell is read.

    Returns:
        Cells of the origins (2, M); boundaries crossed (2, M) and distances (M,) as of ``start_walk``; ranges known so
        far (M,), limit, or 0 for origins outside the grid where the outside is occupied; and the indices of the rays
        that remain to be walked.
    """
    origin = cell.T.astype(np.int64)
    k, t = start_walk(flags, r, cell, window, limit)
    ranges = np.full(len(cell), limit, t.dtype)
    if {"ORIGINS_OUTSIDE", "OUTSIDE_OCCUPIED"} <= flags:
        outside = off_grid(origin, window.rows, window.cols)
        ranges[outside] = 0
        return origin, k, t, ranges, np.flatnonzero(~outside)
    return origin, k, t, ranges, np.flatnonzero(t < limit)


def turn_of(direction: np.ndarray) -> np.ndarray:
    """Return (2, M) directions as parts of a full turn in [0, 1], within 2e-6."""
    real = direction.dtype.type
    x, y = np.abs(direction)
    a = np.where(x > y, y / x, x / y)
    s = a * a
    c1, c3, c5, c7, c9 = (real(c) for c in _TURNS)
    eighth = a * (c1 + s * (c3 + s * (c5 + s * (c7 + s * c9))))
    quarter = np.where(x > y, eighth, real(0.25) - eighth)
    upper = np.where(direction[0] >= 0, quarter, real(0.5) - quarter)
    return np.where(direction[1] >= 0, upper, real(1) - upper)


def angle_bin(direction: np.ndarray, bins: int) -> np.ndarray:
    """Return the angle bins with the nearest centres; centres are at 0, 1 / bins, ... of a turn."""
    real = direction.dtype.type
    index = (turn_of(direction) * real(bins) + real(0.5)).astype(np.int64)
    return np.where(index >= bins, index - bins, index)


def expected_range(flags, t, scale):
    """Convert distances in cells to metres: exactly range_max where no obstacle is nearer, or none with AMCL_LINES."""
    if "AMCL_LINES" in flags:
        return np.where(t == scale.limit, scale.range_max, t * scale.resolution)
    return np.where(t >= scale.limit, scale.range_max, np.minimum(t * scale.resolution, scale.range_max))
