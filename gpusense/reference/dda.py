"""Expected range by the plain walk of Amanatides and Woo (1987), cell by cell.

It is exact, with the same bits as the exact caster. The table holds 1 for occupied cells in a ring of twos.
"""

import numpy as np

from gpusense.reference.ray import make_ray, start_casts
from gpusense.reference.rectangles import padded


def cast_ray(flags, map_table, window, cell, pose, ray, limit, caster):
    """Return the distance in cells to the first occupied cell, limit where none is nearer.

    ``flags``: flags of the signature table; ``cell``: (M, 2) integer column and row of each origin; ``pose``: (M, 4)
    fraction of the cell in x and y, cosine and sine of the heading; ``ray``: (M, 2) cosine and sine of each bearing.
    """
    r = make_ray(pose, ray)
    origin, k, t, ranges, active = start_casts(flags, r, cell, window, limit)
    while len(active):
        at = origin[:, active] + r.step[:, active] * k[:, active].astype(np.int64)
        state = map_table[padded(at[1], at[0], window.cols)]
        hit = state != 0 if "OUTSIDE_OCCUPIED" in flags else state == 1
        ranges[active[hit]] = t[active[hit]]
        active = active[state == 0]
        t_x, t_y = (k[:, active] + r.a[:, active]) * r.inv[:, active]
        by_x = t_x <= t_y
        t[active] = np.minimum(t_x, t_y)
        k[0, active] += by_x
        k[1, active] += ~by_x
        active = active[t[active] < limit]
    return ranges
