"""Expected range by Bresenham's line (1965) from the origin's cell to the cell at the ray's end.

nav2_amcl and Beluga cast rays by it. Distances are from cell centre to cell centre, and a line may pass between two
cells that touch at a corner. The table holds 1 for occupied cells in a ring of twos.

A line midway between two cells steps diagonally, with BELUGA_LINES straight ahead. With AMCL_LINES a line goes on
for a cell beyond its end.
"""

from __future__ import annotations

import numpy as np

from gpusense.interface import structs
from gpusense.reference.ray import make_ray, off_grid, start_casts
from gpusense.reference.rectangles import padded


def cast_ray(
    flags: frozenset[str], map_table: np.ndarray, window: structs.Window, cell: np.ndarray, pose: np.ndarray,
    ray: np.ndarray, limit: float, caster: structs.Caster,
) -> np.ndarray:  # fmt: skip
    """Return the distance in cells from the origin's cell to the first occupied cell of the line, limit without one.

    The arguments are those of ``dda.cast_ray``.
    """
    r = make_ray(pose, ray)
    origin, k, t, ranges, active = start_casts(flags, r, cell, window, limit)
    first = origin + r.step * k.astype(np.int64)
    end = origin + np.floor(pose[:, :2].T + limit * r.direction).astype(np.int64)
    far = np.abs(end - first)
    longer, shorter = far.max(axis=0), far.min(axis=0)
    sign = np.where(end > first, 1, -1)
    if "BELUGA_LINES" in flags:
        active = active[~off_grid(origin[:, active], window.rows, window.cols)]
    last = longer + 1 if "AMCL_LINES" in flags else longer
    flat = far[0] >= far[1]
    aside, error, along = np.zeros(len(cell), np.int64), np.zeros(len(cell), np.int64), 0
    while len(active):
        x = np.where(flat[active], along, aside[active])
        y = np.where(flat[active], aside[active], along)
        at = first[:, active] + sign[:, active] * np.stack([x, y])
        state = map_table[padded(at[1], at[0], window.cols)]
        hit = state != 0 if "OUTSIDE_OCCUPIED" in flags else state == 1
        i, j = x[hit].astype(pose.dtype), y[hit].astype(pose.dtype)
        ranges[active[hit]] = t[active[hit]] + np.sqrt(i * i + j * j)
        active = active[state == 0]
        error[active] += shorter[active]
        twice = 2 * error[active]
        over = active[twice > longer[active] if "BELUGA_LINES" in flags else twice >= longer[active]]
        aside[over] += 1
        error[over] -= longer[over]
        along += 1
        active = active[along <= last[active]]
    return ranges
