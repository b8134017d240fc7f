"""Expected range by marching through the distance field (sphere tracing).

Each step is the distance from the current cell's centre to the nearest obstacle's centre less slack, and at least
tolerance. A slack of sqrt(2) lets only steps of length tolerance pass an obstacle: a range is too long by at most
tolerance, and an obstacle is missed only where the ray's path through it is shorter than tolerance. With slack 0, as in
other programs, any step may pass obstacles.
"""

import numpy as np

from gpusense.reference.ray import make_ray, off_grid, start_walk

LEAST_STEP = 2.0**-22


def cast_ray(flags, map_table, window, cell, pose, ray, limit, caster):
    """Return the distance in cells to a point in an occupied cell, limit where none is nearer.

    The arguments are those of ``dda.cast_ray``, with distances between cell centres [cells] as ``map_table``. The
    caster has the difference between the distance and a step, and the least step [cells].
    """
    real = pose.dtype.type
    r = make_ray(pose, ray)
    origin = cell.T.astype(np.int64)
    ranges = np.full(len(cell), limit, pose.dtype)
    outside = off_grid(origin, window.rows, window.cols)
    if "OUTSIDE_OCCUPIED" in flags:
        ranges[outside] = 0
        t = np.where(outside, limit, real(0))
    else:
        t = start_walk(flags, r, cell, window, limit)[1]
        t = np.where(outside, t + (caster.tolerance + t * real(LEAST_STEP)), t)
    active = np.flatnonzero(t < limit)
    while len(active):
        place = pose[active, :2].T + t[active] * r.direction[:, active]
        at = origin[:, active] + np.floor(place).astype(np.int64)
        off = off_grid(at, window.rows, window.cols)
        if "OUTSIDE_OCCUPIED" in flags:
            ranges[active[off]] = t[active[off]]
        active, at = active[~off], at[:, ~off]
        distance = map_table[at[1] * window.cols + at[0]].astype(pose.dtype)
        hit = distance == 0
        ranges[active[hit]] = t[active[hit]]
        active, distance = active[~hit], distance[~hit]
        t[active] += np.maximum(distance - caster.slack, caster.tolerance + t[active] * real(LEAST_STEP))
        active = active[t[active] < limit]
    return ranges
