"""Expected range z*: distance from a beam's origin to the first occupied cell, exactly (book section 6.3).

An Amanatides-Woo walk that crosses a whole empty square at a time and visits the same cells: crossing distances are
``(k + a) * inv`` with an integer count k, never accumulated, and ties (corners) step in x first. Every operation is
rounded as on the devices, so float32 ranges are theirs to the bit.
"""

from __future__ import annotations

import numpy as np

TINY = 1e-30
BLOCK = 1 << 15


def ray_direction(pose: np.ndarray, ray: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit direction in the grid's frame: pose (..., 4) = (frac x, frac y, cos, sin) turned by ray (..., 2)."""
    cos, sin = pose[..., 2], pose[..., 3]
    dx = cos * ray[..., 0] - sin * ray[..., 1]
    dy = sin * ray[..., 0] + cos * ray[..., 1]
    zero = pose.dtype.type(0)
    return np.where(np.abs(dx) < TINY, zero, dx), np.where(np.abs(dy) < TINY, zero, dy)


def crossed_before(t: np.ndarray, speed: np.ndarray, a: np.ndarray, inv: np.ndarray) -> np.ndarray:
    """Number of boundaries k = 0, 1, ... whose distance (k + a) * inv is below t."""
    guess = np.maximum(np.ceil(t * speed - a), 0)
    more = (guess + a) * inv < t
    fewer = (guess > 0) & ((guess - 1 + a) * inv >= t) & ~more
    return guess + more - fewer


def crossed_until(t: np.ndarray, speed: np.ndarray, a: np.ndarray, inv: np.ndarray) -> np.ndarray:
    """The same, those at t included."""
    guess = np.maximum(np.floor(t * speed - a) + 1, 0)
    more = (guess + a) * inv <= t
    fewer = (guess > 0) & ((guess - 1 + a) * inv > t) & ~more
    return guess + more - fewer


def cast_ray(
    flags: frozenset[str],
    squares: np.ndarray,
    rows: int,
    cols: int,
    cell: np.ndarray,
    pose: np.ndarray,
    ray: np.ndarray,
    limit: np.floating,
) -> np.ndarray:
    """Distance in cells to the first occupied cell, or limit where there is none nearer.

    Args:
        flags: Flags of the signature table.
        squares: Padded quadrant squares, flat.
        rows: Rows of the grid.
        cols: Columns of the grid.
        cell: (M, 2) integer column and row of each origin.
        pose: (M, 4) fraction of the cell in x and y, cosine and sine of the heading.
        ray: (M, 2) cosine and sine of each bearing.
        limit: Longest distance in cells.
    """
    real = pose.dtype
    dx, dy = ray_direction(pose, ray)
    right, up = dx >= 0, dy >= 0
    speed = np.stack([np.abs(dx), np.abs(dy)])
    inv = 1 / speed
    a = np.stack([np.where(right, 1 - pose[:, 0], pose[:, 0]), np.where(up, 1 - pose[:, 1], pose[:, 1])])
    step = np.stack([np.where(right, 1, -1), np.where(up, 1, -1)])
    base = (np.where(right, 0, 1) + np.where(up, 0, 2)) * ((rows + 2) * (cols + 2)) + (cols + 3)
    origin = cell.T.astype(np.int64)
    size = np.array([[cols], [rows]])
    found = np.full(len(cell), limit, real)
    k = np.zeros((2, len(cell)), real)
    t = np.zeros(len(cell), real)
    active = np.arange(len(cell))

    if "ORIGINS_OUTSIDE" in flags:
        outside = ((origin < 0) | (origin >= size)).any(axis=0)
        if "OUTSIDE_OCCUPIED" in flags:
            found[outside] = 0
            active = np.flatnonzero(~outside)
        else:
            entered = _enter(origin, size, step, speed, a, inv, k, t, limit)
            active = np.flatnonzero(~outside | entered)

    while len(active):
        at = origin[:, active] + step[:, active] * k[:, active].astype(np.int64)
        side = squares[base[active] + at[1] * (cols + 2) + at[0]]
        stopped = side == 0
        if stopped.any():
            hit = stopped.copy()
            if "OUTSIDE_OCCUPIED" not in flags:
                hit &= ((at >= 0) & (at < size)).all(axis=0)
            found[active[hit]] = t[active[hit]]
            active, side = active[~stopped], side[~stopped]
        i_speed, i_a, i_inv, i_k = speed[:, active], a[:, active], inv[:, active], k[:, active]
        jump = side.astype(real)
        t_x, t_y = (i_k + (jump - 1) + i_a) * i_inv
        now = np.minimum(t_x, t_y)
        by_x = t_x <= t_y
        other = by_x.astype(np.intp)
        own, lane = 1 - other, np.arange(len(active))
        pick = (i_speed[other, lane], i_a[other, lane], i_inv[other, lane])
        i_k[own, lane] += jump
        i_k[other, lane] = np.where(by_x, crossed_before(now, *pick), crossed_until(now, *pick))
        k[:, active] = i_k
        t[active] = now
        active = active[now < limit]
    return found


def _enter(
    origin: np.ndarray,
    size: np.ndarray,
    step: np.ndarray,
    speed: np.ndarray,
    a: np.ndarray,
    inv: np.ndarray,
    k: np.ndarray,
    t: np.ndarray,
    limit: np.floating,
) -> np.ndarray:
    """Move origins outside the grid to the first cell inside; returns which rays enter before the limit."""
    ahead = np.maximum(np.where(step > 0, -origin, origin - (size - 1)), 0)
    beyond = ((origin < 0) | (origin >= size)).any(axis=0)
    entry = np.where(ahead > 0, ((ahead - 1).astype(a.dtype) + a) * inv, a.dtype.type(-1))
    when = np.maximum(entry[0], entry[1])
    enters = beyond & (when >= 0) & (when < limit)
    by_x = entry[0] > entry[1]
    k_x = np.where(by_x, ahead[0], crossed_until(when, speed[0], a[0], inv[0]))
    k_y = np.where(by_x, crossed_before(when, speed[1], a[1], inv[1]), ahead[1])
    k[:, enters] = np.stack([k_x, k_y])[:, enters]
    t[enters] = when[enters]
    at = origin[:, enters] + step[:, enters] * k[:, enters].astype(np.int64)
    enters[enters] = ((at >= 0) & (at < size)).all(axis=0)
    return enters


def expected_range(t: np.ndarray, limit: np.floating, resolution: np.floating, range_max: np.floating) -> np.ndarray:
    """Metres from cells: exactly range_max where nothing is nearer."""
    return np.where(t >= limit, range_max, np.minimum(t * resolution, range_max))


def cast_ranges(
    flags: frozenset[str],
    squares: np.ndarray,
    pose_cell: np.ndarray,
    pose: np.ndarray,
    ray: np.ndarray,
    ranges: np.ndarray,
    rows: int,
    cols: int,
    particles: int,
    rays: int,
    limit: np.floating,
    resolution: np.floating,
    range_max: np.floating,
) -> None:
    """The expected ranges of all particles and rays."""
    block = max(BLOCK // max(rays, 1), 1)
    for first in range(0, particles, block):
        some = slice(first, min(first + block, particles))
        count = some.stop - first
        lanes = (np.repeat(pose_cell[some], rays, axis=0), np.repeat(pose[some], rays, axis=0))
        t = cast_ray(flags, squares, rows, cols, *lanes, np.tile(ray[:rays], (count, 1)), limit)
        ranges[first * rays : some.stop * rays] = expected_range(t, limit, resolution, range_max)
