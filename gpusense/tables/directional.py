"""Build the table of the compressed directional distance transform; the kernel file ``cddt`` defines its layout."""

from __future__ import annotations

import math

import numpy as np

_ENTRY_UNIT, _COSINE_UNIT = 1024, 1 << 30
# Kernels index the entries of a table in 32 bits.
_LIMIT = (1 << 31) - 1


def directional_table(obstacles: np.ndarray, bins: int, *, pruned: bool, outside: bool) -> np.ndarray:
    """Return the int32 table: for each angle bin, lines along its direction with sorted beginnings of obstacles.

    ``pruned``: whether to omit obstacles that begin inside another one of their line; ``outside``: walls around the
    grid.
    """
    rows, cols = obstacles.shape
    row, col = _exposed(np.pad(obstacles, 1, constant_values=outside), outside)
    # One extra line at each end, since corners of cells may be on borders of lines.
    lines = math.ceil(math.hypot(rows + 2, cols + 2)) + 3
    firsts, cosines = np.empty((bins, lines), np.int64), np.empty((bins, 3), np.int64)
    begins, total = [], 0
    for bin in range(bins):
        turn = 2 * math.pi * bin / bins
        cos, sin = math.cos(turn), math.sin(turn)
        corners = [y * cos - x * sin for x in (-1, cols + 1) for y in (-1, rows + 1)]
        low = math.floor(min(corners)) - 1
        line, begin, end = _projected(col, row, cos, sin)
        order = np.lexsort((begin, line))
        line, begin, end = line[order] - low, begin[order], end[order]
        if pruned and len(line):
            separate = _begin_outside(line, begin, end)
            line, begin = line[separate], begin[separate]
        firsts[bin] = total + np.searchsorted(line, np.arange(lines))
        cosines[bin] = round(cos * _COSINE_UNIT), round(sin * _COSINE_UNIT), low
        begins.append(np.rint(begin * _ENTRY_UNIT).astype(np.int32))
        total += len(begin)
    words = -(-rows * cols // 32)
    head = 1 + 3 * bins + bins * lines + 1 + words
    if head + total > _LIMIT:
        raise ValueError(f"bins: must make at most {_LIMIT} entries on this map, got {head + total} with {bins} bins")
    table = np.empty(head + total, np.int32)
    table[0] = lines
    table[1 : 1 + 3 * bins] = cosines.ravel()
    table[1 + 3 * bins : head - words] = head + np.append(firsts.ravel(), total)
    bits = np.packbits(np.append(obstacles.ravel(), np.zeros(-(rows * cols) % 32, bool)), bitorder="little")
    table[head - words : head] = bits.view("<i4")
    table[head:] = np.concatenate(begins)
    return table


def _exposed(padded: np.ndarray, outside: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return rows and columns of occupied cells, ring included, with a free cell among their eight neighbours."""
    free = np.pad(~padded, 1, constant_values=not outside)
    near = np.zeros(padded.shape, bool)
    rows, cols = padded.shape
    for i in range(3):
        for j in range(3):
            near |= free[i : i + rows, j : j + cols]
    row, col = np.nonzero(padded & near)
    return row - 1, col - 1


def _projected(col: np.ndarray, row: np.ndarray, cos: float, sin: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return line, beginning and end of each cell's projections, along the middle of its part of the line."""
    along, across = (col + 0.5) * cos + (row + 0.5) * sin, (row + 0.5) * cos - (col + 0.5) * sin
    half = (abs(cos) + abs(sin)) / 2
    # A cell that touches a line only with a corner is not on the line.
    low, high = np.floor(across - half + 1e-9).astype(np.int64), np.floor(across + half - 1e-9).astype(np.int64)
    lines, begins, ends = [], [], []
    for i in range(int(np.max(high - low, initial=0)) + 1):
        reached = low + i <= high
        line, middle = low[reached] + i, across[reached]
        off = np.clip(line + 0.5, middle - half, middle + half) - middle
        near, far = np.full(len(off), -np.inf), np.full(len(off), np.inf)
        if abs(cos) > 1e-12:
            near, far = np.maximum(near, -0.5 / abs(cos) + off * sin / cos), 0.5 / abs(cos) + off * sin / cos
        if abs(sin) > 1e-12:
            near = np.maximum(near, -0.5 / abs(sin) - off * cos / sin)
            far = np.minimum(far, 0.5 / abs(sin) - off * cos / sin)
        lines.append(line)
        begins.append(along[reached] + near)
        ends.append(along[reached] + far)
    return np.concatenate(lines), np.concatenate(begins), np.concatenate(ends)


def _begin_outside(line: np.ndarray, begin: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the mask of obstacles (sorted by line, then beginning) that begin outside the earlier ones."""
    # Running maximum of the ends within each line: an offset lifts each line above the previous one.
    lift = (np.max(end) - np.min(begin) + 1) * (line - line[0])
    largest_end = np.maximum.accumulate(end + lift)
    separate = np.ones(len(line), bool)
    separate[1:] = (begin + lift)[1:] > largest_end[:-1] + 1e-6
    return separate
