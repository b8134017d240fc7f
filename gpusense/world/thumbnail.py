"""A small picture of a map, for notebooks."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gpusense._util.html import grey_png

if TYPE_CHECKING:
    from gpusense.world.grid import OccupancyGrid

WIDEST = 240
"""Most pixels along a side."""
# Greys of free, unknown and occupied cells; of a pixel of several cells the darkest counts, so that walls remain.
_FREE, _UNKNOWN, _OCCUPIED = 255, 205, 60


def thumbnail(grid: OccupancyGrid) -> bytes:
    """Return a PNG of a map with row 0 at the bottom; empty for a map without cells."""
    if not all(grid.shape):
        return b""
    grey = np.full(grid.shape, _FREE, np.uint8)
    grey[grid.unknown] = _UNKNOWN
    grey[grid.occupied] = _OCCUPIED
    step = -(-max(grid.shape) // WIDEST)
    for axis in (0, 1):
        grey = np.minimum.reduceat(grey, np.arange(0, grey.shape[axis], step), axis=axis)
    return grey_png(grey[::-1])
