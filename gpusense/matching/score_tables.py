"""Tables of integer scores on a device, and their pooled and folded copies, for searches over poses."""

from __future__ import annotations

import math

import numpy as np

from gpusense.backends import Backend
from gpusense.backends.base import Buffer
from gpusense.interface.structs import ScoreTable

_BYTE = np.dtype(np.uint8)
_NO_FLAGS: frozenset[str] = frozenset()
# Columns that a kernel with lanes reads at once; the kernel file ``search`` has the same number.
RUN = 16
# Largest score of a cell.
TOP = 255
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


class ScoreTables:
    """Tables of integer scores of one size on a device.

    Args:
        backend: The device.
        scores: (T, H, W) or (H, W) uint8; row 0 and column 0 touch the tables' origin.
        levels: Number of times that tables can be pooled: a pooled cell covers ``2^levels`` positions along each axis.
        stride: Cells between neighbouring positions.
        beyond: Score of every cell outside a table.

    Attributes:
        shape: Sizes of the tables, as kernels take them.
        levels: Number of times that tables can be pooled.
        stride: Cells between neighbouring positions.
    """

    def __init__(
        self, backend: Backend, scores: np.ndarray, *, levels: int = 0, stride: int = 1, beyond: int = 0
    ) -> None:
        stack = scores[None] if scores.ndim == 2 else scores
        tables, rows, cols = stack.shape
        self.backend, self.levels, self.stride, self._beyond = backend, levels, stride, beyond
        # The margin holds all pooled cells that a table's cells reach, and a run of cells beyond them.
        self.shape = ScoreTable(tables, rows, cols, ((1 << levels) - 1) * stride + RUN)
        if self._cells(self.shape) > _MOST_CELLS:
            raise ValueError(f"scores: must have at most {_MOST_CELLS} cells with margins, got {stack.shape}")
        padded = np.full((tables, rows + 2 * self.shape.margin, cols + 2 * self.shape.margin), beyond, _BYTE)
        inside = slice(self.shape.margin, -self.shape.margin)
        padded[:, inside, inside] = stack
        self._levels: list[Buffer] = [backend.upload(padded)]
        self._folded: dict[int, tuple[Buffer, ScoreTable]] = {}

    @staticmethod
    def _cells(shape: ScoreTable) -> int:
        return shape.tables * (shape.rows + 2 * shape.margin) * (shape.cols + 2 * shape.margin)

    @property
    def table_bytes(self) -> int:
        """Bytes of all tables made on the device so far."""
        folded = sum(self._cells(shape) for _, shape in self._folded.values())
        return len(self._levels) * self._cells(self.shape) + folded

    def level(self, level: int) -> Buffer:
        """Return the tables of a level; a cell is the largest score of ``2^level`` positions along each axis."""
        while len(self._levels) <= level:
            made = self.backend.empty(self._cells(self.shape), _BYTE)
            reach = (1 << (len(self._levels) - 1)) * self.stride
            size = (self.shape.cols + 2 * self.shape.margin, self.shape.rows + 2 * self.shape.margin, self.shape.tables)
            pool = self.backend.compile("pool_scores", _NO_FLAGS)
            pool(size, self._levels[-1], made, self.shape, reach)
            self._levels.append(made)
        return self._levels[level]

    def folded(self, level: int) -> tuple[Buffer, ScoreTable, int]:
        """Return the tables of a level in which blocks of positions are neighbours, their sizes, and the period."""
        period = self.stride << level
        if period == 1:
            return self.level(0), self.shape, 1
        if level not in self._folded:
            lines, stride = self.shape.rows + 2 * self.shape.margin, self.shape.cols + 2 * self.shape.margin
            shape = ScoreTable(self.shape.tables * period**2, -(-lines // period), -(-stride // period), RUN)
            if self._cells(shape) > _MOST_CELLS:
                raise ValueError(f"scores: a search must fold at most {_MOST_CELLS} cells, got {self._cells(shape)}")
            made = self.backend.empty(self._cells(shape), _BYTE)
            size = (shape.cols + 2 * RUN, shape.rows + 2 * RUN, shape.tables)
            fold = self.backend.compile("fold_scores", _NO_FLAGS)
            fold(size, self.level(level), made, self.shape, shape, period, self._beyond)
            self._folded[level] = made, shape
        return *self._folded[level], period
