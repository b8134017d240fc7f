"""Density of one reading from a table of log p over bins of readings and expected ranges.

Row i is a bin of readings; the last row is for max readings (log probabilities). Column j is a bin of expected ranges;
the last column is for rays without an obstacle.
"""

from __future__ import annotations

import numpy as np

from gpusense.interface import structs


def range_bin(distance: np.ndarray, per_metre: float, cells: int, range_max: float) -> np.ndarray:
    """Return bins of ranges; the last one, after the cells, is for range_max and more."""
    inside = np.where(distance < range_max, distance, 0)
    bins = np.minimum((inside * per_metre).astype(np.int64), cells - 1)
    return np.where(distance >= range_max, cells, bins)


def tabulated_density(
    z: np.ndarray, expected: np.ndarray, sensor: np.ndarray, tables: structs.MixtureTables, range_max: float
) -> np.ndarray:
    """Return log p of readings by the table."""
    column = range_bin(expected, tables.per_metre, tables.cells, range_max)
    return sensor[range_bin(z, tables.per_metre, tables.cells, range_max) * (tables.cells + 1) + column]
