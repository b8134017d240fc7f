"""Expected range z*: distance from a beam's origin to the first occupied cell, exactly (book section 6.3).

An Amanatides-Woo walk that crosses a whole empty square at a time and visits the same cells; ties (corners) step in x
first.
"""

from __future__ import annotations

import numpy as np

from gpusense.reference.ray import crossed_before, crossed_until, make_ray, off_grid, start_casts


def cast_ray(
    flags: frozenset[str],
    map_table: np.ndarray,
    rows: int,
    cols: int,
    cell: np.ndarray,
    pose: np.ndarray,
    ray: np.ndarray,
    limit: np.floating,
    bins: int,
    slack: np.floating,
    tolerance: np.floating,
) -> np.ndarray:
    """Distance in cells to the first occupied cell, or limit where there is none nearer.

    Args:
        flags: Flags of the signature table.
        map_table: Padded quadrant squares, flat.
        rows: Rows of the grid.
        cols: Columns of the grid.
        cell: (M, 2) integer column and row of each origin.
        pose: (M, 4) fraction of the cell in x and y, cosine and sine of the heading.
        ray: (M, 2) cosine and sine of each bearing.
        limit: Longest distance in cells.
        bins: Not used.
        slack: Not used.
        tolerance: Not used.
    """
    r = make_ray(pose, ray)
    origin, k, t, found, active = start_casts(flags, r, cell, rows, cols, limit)
    plane = (np.where(r.step[0] > 0, 0, 1) + np.where(r.step[1] > 0, 0, 2)) * ((rows + 2) * (cols + 2)) + (cols + 3)
    while len(active):
        at = origin[:, active] + r.step[:, active] * k[:, active].astype(np.int64)
        side = map_table[plane[active] + at[1] * (cols + 2) + at[0]]
        stopped = side == 0
        if stopped.any():
            hit = stopped if "OUTSIDE_OCCUPIED" in flags else stopped & ~off_grid(at, rows, cols)
            found[active[hit]] = t[active[hit]]
            active, side = active[~stopped], side[~stopped]
        speed, a, inv, crossed = r.speed[:, active], r.a[:, active], r.inv[:, active], k[:, active]
        jump = side.astype(pose.dtype)
        t_x, t_y = (crossed + (jump - 1) + a) * inv
        now = np.minimum(t_x, t_y)
        by_x = t_x <= t_y
        other = by_x.astype(np.intp)
        own, lane = 1 - other, np.arange(len(active))
        pick = (speed[other, lane], a[other, lane], inv[other, lane])
        crossed[own, lane] += jump
        crossed[other, lane] = np.where(by_x, crossed_before(now, *pick), crossed_until(now, *pick))
        k[:, active] = crossed
        t[active] = now
        active = active[now < limit]
    return found
