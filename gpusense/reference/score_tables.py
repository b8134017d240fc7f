"""Tables of scores for searches over poses: pooled, folded, and packed as numbers; see :mod:`.search`."""

from __future__ import annotations

import numpy as np

from gpusense.interface.constants import TOP
from gpusense.interface.structs import ScoreTable
from gpusense.reference.score_cells import padded_lines, padded_stride


def pool_scores(flags, table, pooled, scores, reach):
    """Write the maximum of each cell and the cells up to ``reach`` rows and columns further."""
    lines, stride = padded_lines(scores), padded_stride(scores)
    images = table[: scores.tables * lines * stride].reshape(scores.tables, lines, stride)
    line = np.minimum(np.arange(lines) + reach, lines - 1)
    col = np.minimum(np.arange(stride) + reach, stride - 1)
    rows = np.maximum(images, images[:, line])
    pooled[: images.size] = np.maximum(rows, rows[:, :, col]).ravel()


def fold_scores(flags, table, out, scores, folded, period, step, beyond, unit):
    """Write the losses of every period-th row and column of each table as an image, for first cells step apart."""
    lines, stride = padded_lines(scores), padded_stride(scores)
    images = table[: scores.tables * lines * stride].reshape(scores.tables, lines, stride)
    side = period // step
    shape = (scores.tables, side, side, padded_lines(folded), padded_stride(folded))
    target = out[: int(np.prod(shape))].reshape(shape)
    target[...] = (TOP - beyond) // unit
    margin = folded.margin
    for i in range(side):
        for j in range(side):
            part = images[:, i * step :: period, j * step :: period]
            target[:, i, j, margin : margin + part.shape[1], margin : margin + part.shape[2]] = (TOP - part) // unit


def quarters_at(table: np.ndarray, scores: ScoreTable, reach: int) -> np.ndarray:
    """Return the scores (T, H, W, 4) of the quarters of the blocks that begin at cells."""
    lines, stride = padded_lines(scores), padded_stride(scores)
    images = table[: scores.tables * lines * stride].reshape(scores.tables, lines, stride)
    line, col = (np.minimum(np.arange(size) + reach, size - 1) for size in (lines, stride))
    return np.stack([images, images[:, :, col], images[:, line], images[:, line][:, :, col]], axis=-1)


def packed_losses(most: np.ndarray, four: np.ndarray) -> np.ndarray:
    """Return losses of quarters as bytes of numbers."""
    losses = np.ascontiguousarray(most[..., None] - four, dtype="u1")
    packed: np.ndarray = losses.view("<u4").astype(np.uint32).view(np.int32).ravel()
    return packed


def pack_quarters(flags, table, quarters, scores, reach):
    """Write the losses of the quarters of the block that begins at each cell, relative to the largest of them."""
    four = quarters_at(table, scores, reach)
    quarters[: four.size // 4] = packed_losses(four.max(axis=-1), four)


def fold_quarters(flags, table, bound, quarters, scores, bounds, folded, period, step, reach, beyond, unit, across):
    """Write the losses of the quarters of blocks, relative to the folded table of bounds, as images."""
    four, side = quarters_at(table, scores, reach), period // step
    shape = (scores.tables, period, period, padded_lines(folded), padded_stride(folded))
    images = np.full((*shape, 4), beyond, np.int32)
    margin, ahead = folded.margin, bounds.margin - folded.margin
    losses = bound[: bounds.tables * padded_lines(bounds) * padded_stride(bounds)]
    losses = losses.reshape(scores.tables, side, side, padded_lines(bounds), padded_stride(bounds))
    losses = losses[..., ahead : ahead + shape[3], ahead : ahead + shape[4]]
    for i in range(period):
        for j in range(period):
            part = four[:, i::period, j::period]
            images[:, i, j, margin : margin + part.shape[1], margin : margin + part.shape[2]] = part
    most = TOP - unit * losses.astype(np.int32).repeat(step, axis=1).repeat(step, axis=2)
    if across:
        most, images = most.swapaxes(3, 4), images.swapaxes(3, 4)
    quarters[: most.size] = packed_losses(most, images)


def pack_rows(flags, table, packed, scores):
    """Write the losses of each cell and the three below it as bytes of a number."""
    lines, stride = padded_lines(scores), padded_stride(scores)
    images = table[: scores.tables * lines * stride].reshape(scores.tables, lines, stride)
    below = [images[:, np.minimum(np.arange(lines) + i, lines - 1)] for i in range(4)]
    packed[: images.size] = np.stack(below, axis=-1).view("<i4").ravel()
