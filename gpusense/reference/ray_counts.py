"""Counts of hits and misses of cells, of which the log-odds of an occupancy grid are sums (book section 9.2).

Start and end of a ray are integers in units of 1/4096 cell, and the walk from cell to cell compares products of
integers, so that all backends visit the same cells. A ray misses each cell that it leaves. Its last cell is hit where
the ray ends at an obstacle, and missed otherwise. A tie, the ray through a corner, steps in x first.
"""

from __future__ import annotations

import numpy as np

from gpusense.interface.constants import RAY_BITS as BITS

UNIT = 1 << BITS


def to_boundary(position: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Return the distance along an axis to the first boundary that a ray crosses."""
    inside = position & (UNIT - 1)
    return np.where(step > 0, UNIT - inside, inside)


def count_rays(
    flags: frozenset[str],
    start: np.ndarray,
    end: np.ndarray,
    hit: np.ndarray,
    hits: np.ndarray,
    misses: np.ndarray,
    rows: int,
    cols: int,
    rays: int,
) -> None:
    """Add the cells of rays to the counts; cells outside the grid are left out."""
    begin, last = start[:rays].astype(np.int64), end[:rays].astype(np.int64)
    cell, goal = begin >> BITS, last >> BITS
    step = np.where(last >= begin, 1, -1)
    size = np.abs(last - begin)
    steps = np.abs(goal - cell)
    first = to_boundary(begin, step)
    # Negative where the next boundary is one in x.
    lead = first[:, 0] * size[:, 1] - first[:, 1] * size[:, 0]
    ended = np.asarray(hit[:rays]) != 0
    active = np.arange(rays)
    while len(active):
        at_end = steps.sum(axis=1) == 0
        inside = ((cell >= 0) & (cell < (cols, rows))).all(axis=1)
        index = cell[:, 1] * cols + cell[:, 0]
        struck = at_end & ended[active]
        np.add.at(hits, index[inside & struck], 1)
        np.add.at(misses, index[inside & ~struck], 1)
        in_x = (steps[:, 0] > 0) & ((steps[:, 1] == 0) | (lead <= 0))
        lead = np.where(in_x, lead + UNIT * size[:, 1], lead - UNIT * size[:, 0])
        moved = np.stack([in_x, ~in_x], axis=1)
        cell, steps = cell + moved * step, steps - moved
        on = ~at_end
        active, cell, steps, step = active[on], cell[on], steps[on], step[on]
        size, lead = size[on], lead[on]
