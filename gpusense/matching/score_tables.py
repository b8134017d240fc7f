"""Tables of integer scores on a device, and their pooled and folded copies, for searches over poses."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from gpusense.backends import Backend
from gpusense.backends.base import Buffer
from gpusense.interface.constants import FEW, RUN, SHIFT_ROWS, TOP
from gpusense.interface.lanes import with_lanes_flag
from gpusense.interface.structs import ScoreTable

_BYTE, _INT = np.dtype(np.uint8), np.dtype(np.int32)
_NO_FLAGS: frozenset[str] = frozenset()
# Levels between the blocks of a level and the steps of their first cells, and scores in a unit of the losses of folded
# tables, by kind of device: processors add losses of several points in a byte, and need few images in their caches, one
# level less for tables of more cells.
_STEP, _UNIT, _FEW_CELLS = {"cpu": 3, "gpu": 8}, {"cpu": FEW, "gpu": 1}, 1 << 20
# Cells of a table and of its copies, which kernels index in 32 bits.
_MOST_CELLS = (1 << 31) - 1


def quantized(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """Round values from ``low`` to ``high`` to scores from 0 to 255; all are 0 without a difference."""
    if not high > low:
        return np.zeros(np.shape(values), _BYTE)
    return np.rint((np.clip(values, low, high) - low) * (TOP / (high - low))).astype(_BYTE)


def field_scores(distances: np.ndarray, sigma: float, max_distance: float) -> np.ndarray:
    """Return scores of distances [m], which fall like a normal density from 255 to 0 at ``max_distance``."""
    values = np.exp(-0.5 * (np.minimum(distances, max_distance) / sigma) ** 2)
    return quantized(values, math.exp(-0.5 * (max_distance / sigma) ** 2), 1.0)


class Folded(NamedTuple):
    """Tables of a level as images, one per first cell of blocks."""

    table: Buffer  # the images, as bytes for a kernel in lanes, otherwise with four rows in a number
    flags: frozenset[str]  # flags of the kernel that reads them
    shape: ScoreTable  # their sizes
    unit: int  # scores in a unit of a loss
    quarters: Buffer | None  # losses of the blocks' quarters, relative to the blocks, as images; None at level 0
    quarters_shape: ScoreTable  # their sizes


def cells_of(shape: ScoreTable) -> int:
    """Return the cells of one table with its margins."""
    return (shape.cols + 2 * shape.margin) * (shape.rows + 2 * shape.margin)


def _all_cells(shape: ScoreTable) -> int:
    return shape.tables * cells_of(shape)


def _launched(shape: ScoreTable) -> tuple[int, int, int]:
    """Return the columns, rows and number of tables with their margins."""
    return shape.cols + 2 * shape.margin, shape.rows + 2 * shape.margin, shape.tables


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
        # The columns of folded quarters lie across where the search chooses blocks by columns.
        self.across = int(backend.info.kind == "gpu")
        self._fine = _STEP[backend.info.kind] - (stack.size > _FEW_CELLS)
        # The margin holds all pooled cells that a table's cells reach, and a run of cells beyond them.
        self.shape = ScoreTable(tables, rows, cols, ((1 << levels) - 1) * stride + self.step(levels) - 1 + RUN)
        cells, info, self._size = _all_cells(self.shape), backend.info, _launched(self.shape)
        if cells > _MOST_CELLS:
            raise ValueError(f"scores: must have at most {_MOST_CELLS} cells with margins, got {stack.shape}")
        # Scores, one table of larger blocks, bounds, and the losses of four blocks at each level.
        if (needed := (6 + 4 * levels) * cells) > info.memory:
            raise MemoryError(
                f"grid: a search of {tables * rows * cols} cells takes {needed / 1e9:.2g} GB of tables, "
                f"but {info.name} has {info.memory / 1e9:.2g} GB; use a map with larger cells, or a part of it"
            )
        padded = np.full((tables, rows + 2 * self.shape.margin, cols + 2 * self.shape.margin), beyond, _BYTE)
        inside = slice(self.shape.margin, -self.shape.margin)
        padded[:, inside, inside] = stack
        self._levels: list[Buffer] = [backend.upload(padded)]
        self._folded: dict[int, Folded] = {}
        self._quarters: dict[int, Buffer] = {}

    def step(self, level: int) -> int:
        """Return the cells between neighbouring first cells of the folded tables of a level."""
        return 1 << max(level - self._fine, 0)

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
        made = self.backend.empty(_all_cells(self.shape), _BYTE)
        self.backend.compile("pool_scores", _NO_FLAGS)(self._size, table, made, self.shape, reach)
        return made

    def quarters(self, level: int) -> Buffer:
        """Return the losses of four blocks of a level, relative to the block that they make, as bytes of numbers."""
        if level not in self._quarters:
            table, made = self.level(level), self.backend.empty(_all_cells(self.shape), _INT)
            self.backend.compile("pack_quarters", _NO_FLAGS)(
                self._size, table, made, self.shape, self.stride << level
            )  # fmt: skip
            self._quarters[level] = made
        return self._quarters[level]

    def folded(self, level: int) -> Folded:
        """Return the losses of a level in tables in which blocks of positions are neighbours.

        Their cells begin at multiples of a step, so a cell covers additional cells for points off the multiples.
        Losses of poses are exact; losses of blocks are rounded down to units. Losses of quarters are exact, and there
        is an image for each first cell.
        """
        if level not in self._folded:
            period, step, unit = self.stride << level, self.step(level), _UNIT[self.backend.info.kind] if level else 1
            cols, lines, tables = self._size
            size = -(-lines // period), -(-cols // period)
            flags = with_lanes_flag(self.backend.info.lanes, "shift_scores", _NO_FLAGS)
            # A kernel reads no more neighbours of a cell.
            shape = ScoreTable(tables * (period // step) ** 2, *size, RUN if flags else SHIFT_ROWS)
            exact = ScoreTable(tables * period**2, *size, 1)
            if (most := max(map(_all_cells, (shape, exact)))) > _MOST_CELLS:
                raise ValueError(f"scores: a search must fold at most {_MOST_CELLS} cells, got {most}")
            made, quarters = self.backend.empty(_all_cells(shape), _BYTE), None
            source = self._pooled(self.level(level), step - 1) if step > 1 else self.level(level)
            self.backend.compile("fold_scores", _NO_FLAGS)(
                _launched(shape), source, made, self.shape, shape, period, step, self._beyond, unit
            )
            if level:
                quarters = self.backend.empty(_all_cells(exact), _INT)
                self.backend.compile("fold_quarters", _NO_FLAGS)(
                    _launched(exact), self.level(level - 1), made, quarters, self.shape, shape, exact, period, step,
                    period // 2, self._beyond, unit, self.across,
                )  # fmt: skip
            table = made
            if not flags:
                table = self.backend.empty(_all_cells(shape), _INT)
                self.backend.compile("pack_rows", _NO_FLAGS)(_launched(shape), made, table, shape)
            # Copies live until the launches have ended.
            self.backend.synchronize()
            self._folded[level] = Folded(table, flags, shape, unit, quarters, exact)
        return self._folded[level]
