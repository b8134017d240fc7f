"""The density of one reading from a table of log p over bins of readings and expected ranges, instead of a formula.

Row i is a bin of readings; column j a bin of expected ranges, and the last column is for rays without an obstacle.
"""

from __future__ import annotations

import numpy as np


def range_bin(distance: np.ndarray, per_metre: np.floating, cells: int) -> np.ndarray:
    """Bins of ranges; what is at the end or beyond belongs to the last one."""
    finite = np.where(np.isfinite(distance), distance, 0)
    return np.minimum((finite * per_metre).astype(np.int64), cells - 1)


def tabulated_density(
    z: np.ndarray,
    expected: np.ndarray,
    sensor: np.ndarray,
    cells: int,
    per_metre: np.floating,
    range_max: np.floating,
) -> np.ndarray:
    """log p of readings by the table."""
    column = np.where(expected >= range_max, cells, range_bin(expected, per_metre, cells))
    return sensor[range_bin(z, per_metre, cells) * (cells + 1) + column]
