"""Arguments that the models share: the map against the range, and the precision."""

from __future__ import annotations

import numpy as np

from gpusense import _checks
from gpusense.backends import Backend
from gpusense.grid import OccupancyGrid

# Up to this many cells float32 knows the place of a crossing to 5/16 of a cell; from half a cell on, neighbouring
# boundaries could be confused.
_MOST_CELLS_PER_RANGE = 1 << 20


def check_scene(grid: object, range_max: float) -> OccupancyGrid:
    """The map, whose cells must not be absurdly small against the range.

    Raises:
        TypeError: not an OccupancyGrid.
        ValueError: more than 1 048 576 cells per range_max.
    """
    if not isinstance(grid, OccupancyGrid):
        raise TypeError(f"grid: must be an OccupancyGrid, got {_checks.show(grid)}")
    cells = range_max / grid.resolution
    if cells > _MOST_CELLS_PER_RANGE:
        raise ValueError(f"range_max: must be at most {_MOST_CELLS_PER_RANGE} cells of the grid, got {cells:.15g}")
    return grid


def real_dtype(precision: str, backend: Backend) -> np.dtype:
    """NumPy dtype of a precision on a device.

    Raises:
        TypeError, ValueError: an unknown precision, or float64 on a device without it.
    """
    dtype = np.dtype(_checks.choice("precision", precision, ("float32", "float64")))
    if dtype == np.float64 and not backend.info.float64:
        raise ValueError(f"precision: must be 'float32' on {backend.info.name}, which has no float64, got 'float64'")
    return dtype
