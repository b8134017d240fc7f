"""Exhaustive search over poses: sums of a table's cells over the end points of a scan.

For one heading the end points fall into integer cells, and the cells of all positions on the grid are the same ones,
shifted. The score of a position is the sum of the table over the shifted cells (Olson, Real-time correlative scan
matching, ICRA 2009). A pooled table holds the largest value of a square of positions, so that its sums are upper bounds
of all scores in the square (Hess et al., Real-time loop closure in 2D lidar SLAM, ICRA 2016). All sums are sums of
integers, so a bound is never below a score that it bounds.

Tables are consecutive, each with a margin of cells around the map. An item is a scan at a heading; its points are
first[item] to first[item + 1] - 1, each of which names the table (image) that it reads. A folded table holds every
period-th cell of a table as a separate image: shifts by whole periods read neighbours. A run is a number of
neighbouring points that read the same cell.
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
    step: int, beyond: int,
) -> None:  # fmt: skip
    """Write every period-th row and column of each padded table as an image, for first cells that are step apart."""
    lines, stride = padded_lines(scores), padded_stride(scores)
    images = table[: scores.tables * lines * stride].reshape(scores.tables, lines, stride)
    side = period // step
    shape = (scores.tables, side, side, padded_lines(folded), padded_stride(folded))
    target = out[: int(np.prod(shape))].reshape(shape)
    target[...] = beyond
    margin = folded.margin
    for i in range(side):
        for j in range(side):
            part = images[:, i * step :: period, j * step :: period]
            target[:, i, j, margin : margin + part.shape[1], margin : margin + part.shape[2]] = part


def shift_scores(
    flags: frozenset[str], table: np.ndarray, run: np.ndarray, image: np.ndarray, weight: np.ndarray,
    first: np.ndarray, runs: np.ndarray, allowed: np.ndarray, score: np.ndarray, scores: ScoreTable, begin: int,
    items: int, height: int, width: int,
) -> None:  # fmt: skip
    """Sum the cells of each item's runs at all shifts by less than height rows and width columns; -1 if not allowed."""
    size = padded_lines(scores) * padded_stride(scores)
    total = score[: items * height * width].reshape(items, height, width)
    rows, cols = np.arange(height)[:, None], np.arange(width)[None, :]
    for item in range(begin, items):
        total[item] = 0
        for k in range(first[item], first[item] + runs[item]):
            cells = table[int(image[k]) * size + cell_index(scores, run[k, 1] + rows, run[k, 0] + cols)]
            total[item] += weight[k] * cells.astype(np.int32)
    total[:, allowed[: height * width].reshape(height, width) == 0] = -1


def row_maxima(flags: frozenset[str], score: np.ndarray, best: np.ndarray, rows: int, width: int) -> None:
    """Find the largest score of each row of shifts, and its first column."""
    values = score[: rows * width].reshape(rows, width)
    place = values.argmax(axis=1)
    best[: 2 * rows : 2] = values[np.arange(rows), place]
    best[1 : 2 * rows : 2] = place


def choose_blocks(
    flags: frozenset[str], score: np.ndarray, best: np.ndarray, low: np.ndarray, high: np.ndarray, block: np.ndarray,
    count: np.ndarray, rows: int, height: int, width: int, turns: int, level: int, room: int, slot: int,
) -> None:  # fmt: skip
    """Collect the shifts whose scores are at least low and less than high of their scan."""
    values = score[: rows * width].reshape(-1, height, width)
    scan = np.arange(len(values)) // turns
    item, row, col = np.nonzero((values >= low[scan][:, None, None]) & (values < high[scan][:, None, None]))
    chosen = np.stack([item, row << level, col << level, values[item, row, col]], axis=1)[:room]
    block[: chosen.size] = chosen.ravel()
    count[slot] += len(item)


def divide_blocks(
    flags: frozenset[str], table: np.ndarray, above: np.ndarray, point: np.ndarray, image: np.ndarray,
    first: np.ndarray, block: np.ndarray, allowed: np.ndarray, low: np.ndarray, part: np.ndarray, count: np.ndarray,
    scores: ScoreTable, blocks: int, height: int, width: int, columns: int, turns: int, level: int, spacing: int,
    slot: int,
) -> None:  # fmt: skip
    """Divide blocks into quarters of 2^level x 2^level, and collect the allowed ones that reach low of their scan."""
    quarter = 1 << level
    quarters = np.array([[0, i, j] for i in (0, quarter) for j in (0, quarter)])
    parts = (block[: 4 * blocks].reshape(blocks, 1, 4)[..., :3] + quarters).reshape(-1, 3)
    parts = parts[(parts[:, 1] < height) & (parts[:, 2] < width)]
    parts = parts[allowed[(parts[:, 1] >> level) * columns + (parts[:, 2] >> level)] > 0]
    total = _sums(table, point, image, first, parts * np.array([1, spacing, spacing]), scores)
    reached = total >= low[parts[:, 0] // turns]
    made = np.column_stack([parts, total])[reached]
    begin = 4 * int(count[slot])
    part[begin : begin + made.size] = made.ravel()
    count[slot] += len(made)


def _sums(
    table: np.ndarray, point: np.ndarray, image: np.ndarray, first: np.ndarray, shifts: np.ndarray, scores: ScoreTable
) -> np.ndarray:
    """Sum the cells of points at shifts (M, 3): an item, and rows and columns of cells."""
    size = padded_lines(scores) * padded_stride(scores)
    total = np.empty(len(shifts), np.int32)
    for item in np.unique(shifts[:, 0]):
        points = slice(first[item], first[item + 1])
        begin = image[points].astype(np.int64) * size
        mine = np.flatnonzero(shifts[:, 0] == item)
        step = max(_BLOCK // max(len(begin), 1), 1)
        for chosen in (mine[i : i + step] for i in range(0, len(mine), step)):
            row = shifts[chosen, 1, None] + point[None, points, 1]
            col = shifts[chosen, 2, None] + point[None, points, 0]
            total[chosen] = table[begin + cell_index(scores, row, col)].sum(axis=1, dtype=np.int32)
    return total
