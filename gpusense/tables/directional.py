"""Builds the table of the compressed directional distance transform; the kernel file ``cddt`` says what it holds."""

from __future__ import annotations

import math

import numpy as np

_ENTRY_UNIT, _COSINE_UNIT = 1024, 1 << 30
_MOST = (1 << 31) - 1


def directional_table(obstacles: np.ndarray, bins: int, *, pruned: bool, outside: bool) -> np.ndarray:
    """For each angle bin, lines along its direction with the places in order where obstacles begin.

    Args:
        obstacles: (rows, cols) bool.
        bins: Angle bins of a full turn.
        pruned: Leave out obstacles that begin within another one of the same line.
        outside: Whether what lies outside the grid is a wall.

    Returns:
        int32 table.

    Raises:
        ValueError: more than 2^31 entries.
    """
    rows, cols = obstacles.shape
    row, col = _seen(np.pad(obstacles, 1, constant_values=outside), outside)
    # A line more at each end: corners of cells lie on borders of lines.
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
            kept = _begin_outside(line, begin, end)
            line, begin = line[kept], begin[kept]
        firsts[bin] = total + np.searchsorted(line, np.arange(lines))
        cosines[bin] = round(cos * _COSINE_UNIT), round(sin * _COSINE_UNIT), low
        begins.append(np.rint(begin * _ENTRY_UNIT).astype(np.int32))
        total += len(begin)
    words = -(-rows * cols // 32)
    head = 1 + 3 * bins + bins * lines + 1 + words
    if head + total > _MOST:
        raise ValueError(f"bins: must make at most {_MOST} entries on this map, got {head + total} with {bins} bins")
    table = np.empty(head + total, np.int32)
    table[0] = lines
    table[1 : 1 + 3 * bins] = cosines.ravel()
    table[1 + 3 * bins : head - words] = head + np.append(firsts.ravel(), total)
    bits = np.packbits(np.append(obstacles.ravel(), np.zeros(-(rows * cols) % 32, bool)), bitorder="little")
    table[head - words : head] = bits.view("<i4")
    table[head:] = np.concatenate(begins)
    return table


def _seen(padded: np.ndarray, outside: bool) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of occupied cells, ring included, that have a free cell among their eight neighbours."""
    free = np.pad(~padded, 1, constant_values=not outside)
    near = np.zeros(padded.shape, bool)
    rows, cols = padded.shape
    for i in range(3):
        for j in range(3):
            near |= free[i : i + rows, j : j + cols]
    row, col = np.nonzero(padded & near)
    return row - 1, col - 1


def _projected(col: np.ndarray, row: np.ndarray, cos: float, sin: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lines that cells reach, and where each cell begins and ends on the middle of its part of the line."""
    along, across = (col + 0.5) * cos + (row + 0.5) * sin, (row + 0.5) * cos - (col + 0.5) * sin
    half = (abs(cos) + abs(sin)) / 2
    # A cell that only touches a line with its corner is not on it.
    low, high = np.floor(across - half + 1e-9).astype(np.int64), np.floor(across + half - 1e-9).astype(np.int64)
    lines, begins, ends = [], [], []
    for i in range(int(np.max(high - low, initial=0)) + 1):
        some = low + i <= high
        line, middle = low[some] + i, across[some]
        off = np.clip(line + 0.5, middle - half, middle + half) - middle
        near, far = np.full(len(off), -np.inf), np.full(len(off), np.inf)
        if abs(cos) > 1e-12:
            near, far = np.maximum(near, -0.5 / abs(cos) + off * sin / cos), 0.5 / abs(cos) + off * sin / cos
        if abs(sin) > 1e-12:
            near = np.maximum(near, -0.5 / abs(sin) - off * cos / sin)
            far = np.minimum(far, 0.5 / abs(sin) - off * cos / sin)
        lines.append(line)
        begins.append(along[some] + near)
        ends.append(along[some] + far)
    return np.concatenate(lines), np.concatenate(begins), np.concatenate(ends)


def _begin_outside(line: np.ndarray, begin: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Which obstacles, in the order of lines and beginnings, do not begin within an earlier one of their line."""
    # Ends so far, line by line: a line's ends are lifted above all of the line before.
    lift = (np.max(end) - np.min(begin) + 1) * (line - line[0])
    reached = np.maximum.accumulate(end + lift)
    kept = np.ones(len(line), bool)
    kept[1:] = (begin + lift)[1:] > reached[:-1] + 1e-6
    return kept
