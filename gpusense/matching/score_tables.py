"""Tables of integer scores on a device, and their pooled and folded copies, for searches over poses."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gpusense.backends import Backend
from gpusense.backends.base import Buffer
from gpusense.interface.structs import ScoreTable

_BYTE = np.dtype(np.uint8)
_NO_FLAGS: frozenset[str] = frozenset()
# Columns that a kernel with lanes reads at once; the kernel file ``search`` has the same number.
RUN = 16
# Rows of shifts of a work-item, as in the kernel file.
SHIFT_ROWS = 8
# Largest score of a cell.
TOP = 255
# Levels between the blocks of a level and the steps of their first cells, and scores in a unit of the losses of folded
# tables, by kind of device: processors need few images in their caches, and add losses of several points in a byte.
_STEP, _UNIT = {"cpu": 2, "gpu": 8}, {"cpu": 8, "gpu": 1}
# Cells of a table and of its copies, which kernels index in 32 bits.
_MOST_CELLS = (1 << 31) - 1


def quantized(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """Round values from ``low`` to ``high`` to scores from 0 to 255; a score differs by at most half a step.

    A step is ``(high - low) / 255``. All scores are 0 without a difference.
    """
    if not high > low:
        return np.zeros(np.shape(values), _BYTE)
    return np.rint((np.clip(values, low, high) - low) * (TOP / (high - low))).astype(_BYTE)


def field_scores(distances: np.ndarray, sigma: float, max_distance: float) -> np.ndarray:
    """Return scores of distances [m], which fall like a normal density from 255 to 0 at ``max_distance``."""
    values = np.exp(-0.5 * (np.minimum(distances, max_distance) / sigma) ** 2)
    return quantized(values, math.exp(-0.5 * (max_distance / sigma) ** 2), 1.0)


class Folded(NamedTuple):
    """Tables of a level as images, one per first cell of blocks."""

    table: Buffer  # the images
    shape: ScoreTable  # their sizes
    period: int  # cells of the tables between neighbouring cells of an image
    step: int  # cells between first cells of neighbouring images
    offset: int  # column and row of the tables' first cell in the images' source
    unit: int  # scores in a unit of a loss


class ScoreTables:
    """Tables (T, H, W) or (H, W) of integer scores on a device; row 0 and column 0 touch the tables' origin.

    They can be pooled ``levels`` times: a pooled cell covers ``2^levels`` positions along each axis, ``stride`` cells
    apart. Cells outside a table have the score ``beyond``. ``shape`` are the sizes as kernels take them.
    """

    def __init__(
        self, backend: Backend, scores: np.ndarray, *, levels: int = 0, stride: int = 1, beyond: int = 0
    ) -> None:
        stack = scores[None] if scores.ndim == 2 else scores
        tables, rows, cols = stack.shape
        self.backend, self.levels, self.stride, self._beyond = backend, levels, stride, beyond
        # The margin holds all pooled cells that a table's cells reach, and a run of cells beyond them.
        self.shape = ScoreTable(tables, rows, cols, ((1 << levels) - 1) * stride + self.step(levels) - 1 + RUN)
        cells, info = self._cells(self.shape), backend.info
        if cells > _MOST_CELLS:
            raise ValueError(f"scores: must have at most {_MOST_CELLS} cells with margins, got {stack.shape}")
        # Scores, one table of larger blocks, and the losses of four blocks at each level.
        if (needed := (2 + 4 * levels) * cells) > info.memory:
            raise MemoryError(
                f"grid: a search of {tables * rows * cols} cells takes {needed / 1e9:.2g} GB of tables, "
                f"but {info.name} has {info.memory / 1e9:.2g} GB; use a map with larger cells, or a part of it"
            )
        padded = np.full((tables, rows + 2 * self.shape.margin, cols + 2 * self.shape.margin), beyond, _BYTE)
        inside = slice(self.shape.margin, -self.shape.margin)
        padded[:, inside, inside] = stack
        self._levels: list[Buffer] = [backend.upload(padded)]
        self._folded: dict[int, Folded] = {}
        self._quarters: dict[tuple[int, bool], Buffer] = {}

    @staticmethod
    def _cells(shape: ScoreTable) -> int:
        return shape.tables * (shape.rows + 2 * shape.margin) * (shape.cols + 2 * shape.margin)

    @property
    def _size(self) -> tuple[int, int, int]:
        return self.shape.cols + 2 * self.shape.margin, self.shape.rows + 2 * self.shape.margin, self.shape.tables

    def step(self, level: int) -> int:
        """Return the cells between neighbouring first cells of the folded tables of a level."""
        return 1 << max(level - _STEP[self.backend.info.kind], 0)

    def level(self, level: int) -> Buffer:
        """Return the tables of a level; a cell is the largest score of ``2^level`` positions along each axis."""
        while len(self._levels) <= level:
            self._levels.append(self._pooled(self._levels[-1], (1 << (len(self._levels) - 1)) * self.stride))
        return self._levels[level]

    def drop_levels(self) -> None:
        """Free the tables from which others were made."""
        del self._levels[1:]

    def _pooled(self, table: Buffer, reach: int) -> Buffer:
        """Return tables of the largest score of each cell and the cells up to ``reach`` further."""
        made = self.backend.empty(self._cells(self.shape), _BYTE)
        self.backend.compile("pool_scores", _NO_FLAGS)(self._size, table, made, self.shape, reach)
        return made

    def quarters(self, level: int, *, top: bool) -> Buffer:
        """Return the losses of four blocks of a level that make a block of the next one, in the bytes of numbers.

        They are relative to the score of the larger block or, with ``top``, to the largest score of a cell.
        """
        if (level, top) not in self._quarters:
            table, made = self.level(level), self.backend.empty(self._cells(self.shape), np.dtype(np.int32))
            pack = self.backend.compile("pack_quarters", _NO_FLAGS)
            pack(self._size, table, made, self.shape, (1 << level) * self.stride, int(top))
            self._quarters[level, top] = made
        return self._quarters[level, top]

    def folded(self, level: int) -> Folded:
        """Return the losses of a level in tables in which blocks of positions are neighbours.

        Their cells begin at multiples of a step, so a cell covers additional cells for points off the multiples.
        Losses of poses are exact; losses of blocks are rounded down to units.
        """
        period, step, unit = self.stride << level, self.step(level), _UNIT[self.backend.info.kind] if level else 1
        if level not in self._folded:
            lines, stride = self.shape.rows + 2 * self.shape.margin, self.shape.cols + 2 * self.shape.margin
            images = self.shape.tables * (period // step) ** 2
            shape = ScoreTable(images, -(-lines // period), -(-stride // period), RUN)
            if self._cells(shape) > _MOST_CELLS:
                raise ValueError(f"scores: a search must fold at most {_MOST_CELLS} cells, got {self._cells(shape)}")
            made = self.backend.empty(self._cells(shape), _BYTE)
            size = (shape.cols + 2 * RUN, shape.rows + 2 * RUN, shape.tables)
            source = self._pooled(self.level(level), step - 1) if step > 1 else self.level(level)
            fold = self.backend.compile("fold_scores", _NO_FLAGS)
            fold(size, source, made, self.shape, shape, period, step, self._beyond, unit)
            # The pooled copy lives until the launch has ended.
            self.backend.synchronize()
            self._folded[level] = Folded(made, shape, period, step, self.shape.margin, unit)
        return self._folded[level]
