"""Exhaustive search over poses: sums of a table's cells over the end points of a scan.

For one heading the end points fall into integer cells, and the cells of all positions on the grid are the same ones,
shifted. The score of a position is the sum of the table over the shifted cells (Olson, Real-time correlative scan
matching, ICRA 2009). A pooled table holds the largest value of a square of positions, so that its sums are upper bounds
of all scores in the square (Hess et al., Real-time loop closure in 2D lidar SLAM, ICRA 2016). All sums are sums of
integers, so a bound is never below a score that it bounds.

Tables are consecutive, each with a margin of cells around the map. An item is a scan at a heading; its points are
first[item] to first[item + 1] - 1, each of which has the first cell of the table (image) that it reads. A folded table
holds every period-th cell of a table as a separate image: shifts by whole periods read neighbours. It holds losses: the
largest score less the cell's, divided by a unit and rounded down, so that losses of several points fit a byte.
"""

from __future__ import annotations

import numpy as np

from gpusense.interface.constants import TOP
from gpusense.interface.structs import ScoreTable
from gpusense.reference.score_cells import cell_index

# Sums of a block of candidates.
_BLOCK = 1 << 22
# Numbers that count the lines of a scan by their scores.
BINS = 512


def divided(
    quarters: np.ndarray, point: np.ndarray, image: np.ndarray, first: np.ndarray, block: np.ndarray,
    scores: ScoreTable, spacing: int, shift: int, across: int,
) -> np.ndarray:  # fmt: skip
    """Return the scores (M, 4) of the quarters of blocks (M, 4): score less the losses of the item's points."""
    total = np.empty((len(block), 4), np.int32)
    for item in np.unique(block[:, 0]):
        points = slice(first[item], first[item + 1])
        begin = image[points].astype(np.int64)
        mine = np.flatnonzero(block[:, 0] == item)
        step = max(_BLOCK // max(len(begin), 1), 1)
        for chosen in (mine[i : i + step] for i in range(0, len(mine), step)):
            row = spacing * (block[chosen, 1, None] >> shift) + point[None, points, 1]
            col = spacing * (block[chosen, 2, None] >> shift) + point[None, points, 0]
            four = quarters[begin + cell_index(scores, row, col, across=across)]
            for i in range(4):
                total[chosen, i] = block[chosen, 3] - (four >> 8 * i & 255).sum(axis=1, dtype=np.int32)
    return total


def shift_scores(flags, table, point, image, first, allowed, score, scores, items, height, width, unit):
    """Sum the losses of each item's points at all shifts by less than height rows and width columns, and write scores.

    A shift that is not allowed has -1.
    """
    total = score[: items * height * width].reshape(items, height, width)
    rows, cols = np.arange(height)[:, None], np.arange(width)[None, :]
    for item in range(items):
        total[item] = TOP * (first[item + 1] - first[item])
        for k in range(first[item], first[item + 1]):
            cells = table[int(image[k]) + cell_index(scores, point[k, 1] + rows, point[k, 0] + cols)]
            total[item] -= unit * (cells & 255)
    total[:, allowed[: height * width].reshape(height, width) == 0] = -1


def line_maxima(flags, score, best, histogram, all, lines, length, spacing, along, turns, shift):
    """Find the largest score of each line of shifts and its first shift, and count the lines of scans by scores."""
    cells = np.arange(lines)[:, None] * spacing + np.arange(length) * along
    values = score[: all * length].reshape(-1, lines * length)[:, cells].reshape(all, length)
    place, most = values.argmax(axis=1), values.max(axis=1)
    best[: 2 * all : 2], best[1 : 2 * all : 2] = most, np.arange(all) % lines * spacing + place * along
    some = np.flatnonzero(most >= 0)
    np.add.at(histogram, some // (lines * turns) * BINS + (most[some] >> shift), 1)


def promising(best: np.ndarray, histogram: np.ndarray, lines: int, scan: int, shift: int, most: int) -> np.ndarray:
    """Return which of a scan's lines have its ``most`` largest scores, or others as good."""
    above = np.cumsum(histogram[scan * BINS : (scan + 1) * BINS][::-1])
    least = max(BINS - 1 - int(np.searchsorted(above, most)), 0) << shift
    chosen: np.ndarray = best[2 * scan * lines : 2 * (scan + 1) * lines : 2] >= least
    return chosen


def count_promising(flags, best, histogram, number, items, lines, turns, shift, most):
    """Count the promising lines of each item."""
    for scan in range(items // turns):
        chosen = promising(best, histogram, lines * turns, scan, shift, most)
        number[scan * turns : (scan + 1) * turns] = chosen.reshape(turns, lines).sum(axis=1)


def pick_blocks(flags, best, histogram, number, block, items, lines, width, turns, level, shift, most):
    """Take most of the promising lines of each scan, evenly spaced, as blocks; missing blocks have the score -1."""
    each = lines * turns
    made = block[: 4 * most * (items // turns)].reshape(-1, most, 4)
    for scan in range(len(made)):
        chosen = np.flatnonzero(promising(best, histogram, each, scan, shift, most))
        taken = min(len(chosen), most)
        line = chosen[np.arange(taken) * len(chosen) // max(taken, 1)] + scan * each
        at = best[2 * line + 1]
        picked = line // lines, at // width << level, at % width << level, best[2 * line]
        made[scan, :taken], made[scan, taken:, 3] = np.stack(picked, axis=1), -1


def raise_low(flags, block, slack, low, blocks, most):
    """Raise the least scores of scans to the scores of poses less their slack."""
    score = block[: 4 * blocks].reshape(-1, most, 4)[:, :, 3].max(axis=1)
    scans = len(score)
    low[:scans] = np.where(score >= 0, np.maximum(low[:scans], score - slack[:scans]), low[:scans])


def choose_blocks(
    flags, score, best, low, block, count, all, lines, length, spacing, along, width, turns, level, room
):  # fmt: skip
    """Collect the shifts whose scores are at least low of their scan."""
    values = score[: all * length].reshape(-1, lines * length // width, width)
    scan = np.arange(len(values)) // turns
    item, row, col = np.nonzero(values >= low[scan][:, None, None])
    chosen = np.stack([item, row << level, col << level, values[item, row, col]], axis=1)[:room]
    block[: chosen.size] = chosen.ravel()
    count[level] += len(item)


def follow_blocks(
    flags, quarters, point, image, first, allowed, block, scores, blocks, height, width, columns, level, spacing,
    shift, across,
):  # fmt: skip
    """Replace blocks by their best allowed quarters of 2^level x 2^level; a block without any has the score -1."""
    here = block[: 4 * blocks].reshape(blocks, 4)
    mine = np.flatnonzero(here[:, 3] >= 0)
    total = divided(quarters, point, image, first, here[mine], scores, spacing, shift, across)
    parts, within = _quarters_of(here[mine], allowed, height, width, columns, level)
    total = np.where(within, total, -1)
    best = total.argmax(axis=1)
    chosen = np.arange(len(mine)), best
    some = total[chosen] >= 0
    here[mine[some], 1:3] = parts[chosen][some]
    here[mine, 3] = np.maximum(total[chosen], -1)


def divide_blocks(
    flags, quarters, point, image, first, allowed, block, low, part, count, scores, begin, some, room, workers, run,
    height, width, columns, turns, level, spacing, shift, across,
):  # fmt: skip
    """Divide blocks into quarters of 2^level x 2^level, and collect the allowed ones that reach low of their scan."""
    blocks = min(int(count[level + 1]) - begin, some)
    here = block[4 * begin : 4 * (begin + blocks)].reshape(blocks, 4)
    total = divided(quarters, point, image, first, here, scores, spacing, shift, across)
    parts, within = _quarters_of(here, allowed, height, width, columns, level)
    number, which = np.nonzero(within & (total >= low[here[:, 0] // turns, None]))
    made = np.column_stack([here[number, 0], parts[number, which], total[number, which]])
    kept = made[: max(room - int(count[level]), 0)]
    part[4 * int(count[level]) :][: kept.size] = kept.ravel()
    count[level] += len(made)


def _quarters_of(
    block: np.ndarray, allowed: np.ndarray, height: int, width: int, columns: int, level: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return first rows and columns (M, 4, 2) of the quarters of blocks (M, 4), and which are allowed (M, 4)."""
    parts = block[:, None, 1:3] + (np.array([(0, 0), (0, 1), (1, 0), (1, 1)], np.int32) << level)
    row, col = parts[..., 0], parts[..., 1]
    within = (row < height) & (col < width)
    within[within] = allowed[(row[within] >> level) * columns + (col[within] >> level)] > 0
    return parts, within
