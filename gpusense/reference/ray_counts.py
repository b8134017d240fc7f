"""Counts of hits and misses of cells, of which the log-odds of an occupancy grid are sums (book section 9.2).

Start and end of a ray are cells with offsets in units of 1/4096 cell, and the walk from cell to cell compares products
of integers, so that all backends visit the same cells. A ray misses each cell that it leaves. Its last cell is hit
where the ray ends at an obstacle, and missed otherwise. A ray through a corner (a tie) steps in x first.
"""

from __future__ import annotations

import numpy as np

from gpusense.interface.constants import RAY_BITS as BITS

UNIT = 1 << BITS
# The counts' dtype avoids a conversion that makes NumPy's sum twenty times slower.
ONE = np.int32(1)


def to_boundary(inside: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Return the distance along an axis to the first boundary that a ray crosses."""
    return np.where(step > 0, UNIT - inside, inside)


def has_left(cell: np.ndarray, step: np.ndarray, cells: int) -> np.ndarray:
    """Return whether a walk has left the extent of an axis for good."""
    return np.where(step > 0, cell >= cells, cell < 0)


def crossed_before(
    first: np.ndarray, size: np.ndarray, reached: np.ndarray, other: np.ndarray, ties: bool
) -> np.ndarray:
    """Return the number of boundaries of an axis that a ray crosses before a boundary of the other axis.

    ``first``, ``size``: distance to the first boundary, and length of the ray, along the axis; ``reached``, ``other``:
    the same for the other axis; ``ties``: whether simultaneous boundaries count. Products of lengths fit in 64 bits,
    since rays span at most 2^19 cells.
    """
    room = reached * size - first * other - (not ties)
    return np.where(room < 0, 0, room // (UNIT * np.maximum(other, 1)) + 1)


def count_rays(flags, start_cell, start_inside, end_cell, end_inside, hit, hits, misses, rows, cols, rays):
    """Add the cells of rays to the counts; cells outside the grid are left out."""
    # Axes first: a column of numbers is contiguous.
    cell, begin = start_cell[:rays].T.astype(np.int64), start_inside[:rays].T.astype(np.int64)
    across = end_cell[:rays].T - cell
    span = across * UNIT + (end_inside[:rays].T - begin)
    step = np.where(span >= 0, 1, -1)
    size, left = step * span, step * across
    first = to_boundary(begin, step)
    # Skip the steps that bring the walk to the grid's columns and rows.
    most = np.array([[cols - 1], [rows - 1]])
    need = np.maximum(np.where(step > 0, -cell, cell - most), 0)
    reached = first + (need - 1) * UNIT
    along_y = np.minimum(crossed_before(first[1], size[1], reached[0], size[0], False), left[1])
    along_x = np.minimum(crossed_before(first[0], size[0], reached[1], size[1], True), left[0])
    done_y = np.where(need[0] > 0, along_y, 0)
    late = done_y < need[1]
    done = np.stack([np.where(late, along_x, need[0]), np.where(late, need[1], done_y)])
    # Negative where x has the next boundary.
    lead = (first[0] + done[0] * UNIT) * size[1] - (first[1] + done[1] * UNIT) * size[0]
    (size_x, size_y), (step_x, step_y), (left_x, left_y), (col, row) = size, step, left - done, cell + step * done
    ended = np.asarray(hit[:rays]) != 0
    on = (need <= left).all(axis=0)
    col, row, left_x, left_y, lead = col[on], row[on], left_x[on], left_y[on], lead[on]
    size_x, size_y, step_x, step_y, ended = size_x[on], size_y[on], step_x[on], step_y[on], ended[on]
    while len(col):
        at_end = left_x + left_y == 0
        inside = (col >= 0) & (col < cols) & (row >= 0) & (row < rows)
        index, struck = row * cols + col, at_end & ended
        np.add.at(hits, index[inside & struck], ONE)
        np.add.at(misses, index[inside & ~struck], ONE)
        in_x = (left_x > 0) & ((left_y == 0) | (lead <= 0))
        lead = np.where(in_x, lead + UNIT * size_y, lead - UNIT * size_x)
        col, row = np.where(in_x, col + step_x, col), np.where(in_x, row, row + step_y)
        left_x, left_y = left_x - in_x, left_y - ~in_x
        over = at_end | has_left(col, step_x, cols) | has_left(row, step_y, rows)
        if over.any():
            on = ~over
            col, row, left_x, left_y, lead = col[on], row[on], left_x[on], left_y[on], lead[on]
            size_x, size_y, step_x, step_y, ended = size_x[on], size_y[on], step_x[on], step_y[on], ended[on]
