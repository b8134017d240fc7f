"""Exhaustive search over poses: sums of a table's cells over the end points of a scan.

For one heading the end points fall into integer cells, and the cells of all positions on the grid are the same ones,
shifted. The score of a position is the sum of the table over the shifted cells (Olson, Real-time correlative scan
matching, ICRA 2009). A pooled table holds the largest value of a square of positions, so that its sums are upper bounds
of all scores in the square (Hess et al., Real-time loop closure in 2D lidar SLAM, ICRA 2016). All sums are sums of
integers, so a bound is never below a score that it bounds.

Tables are consecutive, each with a margin of cells around the map. An item is a scan at a heading; its points are
first[item] to first[item + 1] - 1, each of which names the table (image) that it reads. A folded table holds every
period-th cell of a table as a separate image: shifts by whole periods read neighbours.
"""

from __future__ import annotations

import numpy as np

from gpusense.interface.structs import ScoreTable
from gpusense.reference.score_cells import cell_index, padded_lines, padded_stride

# Sums of a block of candidates.
_BLOCK = 1 << 22


def pool_scores(flags: frozenset[str], table: np.ndarray, pooled: np.ndarray, scores: ScoreTable, reach: int) -> None:
    """Write the maximum of each cell and the cells up to ``reach`` rows and columns further."""
    lines, stride = padded_lines(scores), padded_stride(scores)
    images = table[: scores.tables * lines * stride].reshape(scores.tables, lines, stride)
    line = np.minimum(np.arange(lines) + reach, lines - 1)
    col = np.minimum(np.arange(stride) + reach, stride - 1)
    rows = np.maximum(images, images[:, line])
    pooled[: images.size] = np.maximum(rows, rows[:, :, col]).ravel()


def fold_scores(
    flags: frozenset[str], table: np.ndarray, out: np.ndarray, scores: ScoreTable, folded: ScoreTable, period: int,
    beyond: int,
) -> None:  # fmt: skip
    """Write every period-th row and column of each padded table as an image, for each of period^2 first cells."""
    lines, stride = padded_lines(scores), padded_stride(scores)
    images = table[: scores.tables * lines * stride].reshape(scores.tables, lines, stride)
    shape = (scores.tables, period, period, padded_lines(folded), padded_stride(folded))
    target = out[: int(np.prod(shape))].reshape(shape)
    target[...] = beyond
    margin = folded.margin
    for i in range(period):
        for j in range(period):
            part = images[:, i::period, j::period]
            target[:, i, j, margin : margin + part.shape[1], margin : margin + part.shape[2]] = part


def shift_scores(
    flags: frozenset[str], table: np.ndarray, point: np.ndarray, image: np.ndarray, first: np.ndarray,
    score: np.ndarray, scores: ScoreTable, items: int, height: int, width: int,
) -> None:  # fmt: skip
    """Sum the cells of each item's points at all shifts by less than height rows and width columns."""
    size = padded_lines(scores) * padded_stride(scores)
    total = score[: items * height * width].reshape(items, height, width)
    total[...] = 0
    rows, cols = np.arange(height)[:, None], np.arange(width)[None, :]
    for item in range(items):
        for k in range(first[item], first[item + 1]):
            begin = int(image[k]) * size
            total[item] += table[begin + cell_index(scores, point[k, 1] + rows, point[k, 0] + cols)]


def candidate_scores(
    flags: frozenset[str], table: np.ndarray, point: np.ndarray, image: np.ndarray, first: np.ndarray,
    candidate: np.ndarray, score: np.ndarray, scores: ScoreTable, candidates: int,
) -> None:  # fmt: skip
    """Sum the cells of candidates' points; a candidate is an item, and the row and column of its shift."""
    size = padded_lines(scores) * padded_stride(scores)
    chosen = candidate[: 3 * candidates].reshape(candidates, 3)
    for item in np.unique(chosen[:, 0]):
        points = slice(first[item], first[item + 1])
        begin = image[points].astype(np.int64) * size
        mine = np.flatnonzero(chosen[:, 0] == item)
        step = max(_BLOCK // max(len(begin), 1), 1)
        for part in (mine[i : i + step] for i in range(0, len(mine), step)):
            row = chosen[part, 1, None] + point[None, points, 1]
            col = chosen[part, 2, None] + point[None, points, 0]
            score[part] = table[begin + cell_index(scores, row, col)].sum(axis=1, dtype=np.int32)
