"""Expected range by Bresenham's line (1965) from the origin's cell to the cell at the ray's end.

nav2_amcl and Beluga cast rays by it. Distances are from cell centre to cell centre, and a line may pass between two
cells that touch at a corner. A line midway between two cells steps diagonally, with BELUGA_LINES straight ahead. With
AMCL_LINES a line goes on for a cell beyond its end.

The table holds the Chebyshev distance to the next occupied cell or to the ring around the grid: a line leaps over that
many cells at once. n cells along a line of l cells that ends s cells aside, it is (2 n s + l) / (2 l) cells aside,
rounded down; straight ahead (2 n s + l - 1) / (2 l).
"""

import numpy as np

from gpusense.reference.ray import make_ray, off_grid, start_casts
from gpusense.reference.rectangles import padded

# The entry of the ring where a line meets nothing outside the grid; cells at which lines end have 0.
EDGE = 255


def cast_ray(flags, map_table, window, cell, pose, ray, limit, caster):
    """Return the distance in cells from the origin's cell to the first occupied cell of the line, limit without one.

    The arguments are those of ``dda.cast_ray``, with Chebyshev distances as ``map_table``.
    """
    r = make_ray(pose, ray)
    origin, k, t, ranges, active = start_casts(flags, r, cell, window, limit)
    first = origin + r.step * k.astype(np.int64)
    end = origin + np.floor(pose[:, :2].T + limit * r.direction).astype(np.int64)
    if "BELUGA_LINES" in flags:
        active = active[~off_grid(origin[:, active], window.rows, window.cols)]
    first, end, t = first[:, active], end[:, active], t[active]
    far, sign = np.abs(end - first), np.where(end > first, 1, -1)
    last = far.max(axis=0) + ("AMCL_LINES" in flags)
    # A line of a single cell goes on diagonally.
    longer = np.maximum(far.max(axis=0), 1)
    shorter = np.where((far == 0).all(axis=0), 1, far.min(axis=0))
    along = np.zeros(len(active), np.int64)
    while len(active):
        aside = (2 * along * shorter + longer - ("BELUGA_LINES" in flags)) // (2 * longer)
        x, y = np.where(far[0] >= far[1], (along, aside), (aside, along))
        at = first + sign * (x, y)
        steps = map_table[padded(at[1], at[0], window.cols)]
        hit = (steps == 0) & (along <= last)
        i, j = x[hit].astype(pose.dtype), y[hit].astype(pose.dtype)
        ranges[active[hit]] = t[hit] + np.sqrt(i * i + j * j)
        along = along + steps
        going = (steps != 0) & (steps != EDGE) & (along <= last)
        active, first, sign, far, t = active[going], first[:, going], sign[:, going], far[:, going], t[going]
        last, longer, shorter, along = last[going], longer[going], shorter[going], along[going]
    return ranges
