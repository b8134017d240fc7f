"""Expected range z*: the exact distance from a beam's origin to the first occupied cell (book section 6.3).

It is an Amanatides-Woo walk that crosses a whole empty rectangle at a time, with the same result. At ties (corners) it
steps in x first.
"""

from __future__ import annotations

import numpy as np

from gpusense.reference.ray import crossed, make_ray, start_casts
from gpusense.reference.rectangles import OCCUPIED, padded_in_groups

# Rows of a group of the planes with the flag ROW_GROUPS.
GROUP = 8


def sectors_of(flags):
    """Return the sectors of each quadrant."""
    return 4 if "SECTORS_4" in flags else 2 if "SECTORS_2" in flags else 1


def sector_of(sectors: int, speed_x: np.ndarray, speed_y: np.ndarray) -> np.ndarray:
    """Return the sector of a direction within its quadrant, from flat to steep.

    A wrong sector would cost steps, but not change the result.
    """
    if sectors == 1:
        return np.zeros(len(speed_x), np.intp)
    steep = speed_y > speed_x
    if sectors == 2:
        return steep.astype(np.intp)
    bound = np.where(steep, speed_x.dtype.type(2.4142136), speed_x.dtype.type(0.41421356))
    return 2 * steep + (speed_y > bound * speed_x)


def cast_ray(flags, map_table, window, cell, pose, ray, limit, caster):
    """Return the distance in cells to the first occupied cell, limit where none is nearer.

    The arguments are those of ``dda.cast_ray``, with padded planes of empty rectangles, flat, as ``map_table``.
    """
    r = make_ray(pose, ray)
    origin, k, t, ranges, active = start_casts(flags, r, cell, window, limit)
    quadrant = np.where(r.step[0] > 0, 0, 1) + np.where(r.step[1] > 0, 0, 2)
    sectors = sectors_of(flags)
    plane = quadrant * sectors + sector_of(sectors, *r.speed)
    group = GROUP if "ROW_GROUPS" in flags else 1
    table = plane * (-(-(window.rows + 2) // group) * group * (window.cols + 2))
    while len(active):
        at = origin[:, active] + r.step[:, active] * k[:, active].astype(np.int64)
        sides = map_table[table[active] + padded_in_groups(at[1], at[0], window.cols, group)]
        stopped = sides <= OCCUPIED
        if stopped.any():
            hit = stopped if "OUTSIDE_OCCUPIED" in flags else sides == OCCUPIED
            ranges[active[hit]] = t[active[hit]]
            active, sides = active[~stopped], sides[~stopped]
        speed, a, inv = r.speed[:, active], r.a[:, active], r.inv[:, active]
        far = k[:, active] + (np.stack([sides & 255, sides >> 8]).astype(pose.dtype) - 1)
        t_x, t_y = (far + a) * inv
        by_x = t_x <= t_y
        now = np.where(by_x, t_x, t_y)
        other = by_x.astype(np.intp)
        axis, index = 1 - other, np.arange(len(active))
        aside = crossed(now, speed[other, index], a[other, index], inv[other, index], ~by_x)
        far[axis, index] += 1
        far[other, index] = aside
        k[:, active] = far
        t[active] = now
        active = active[now < limit]
    return ranges
