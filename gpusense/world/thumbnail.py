"""A small picture of a map, for notebooks."""

from __future__ import annotations

import numpy as np

from gpusense._util.html import grey_png

WIDEST = 240
"""Most pixels along a side."""
# Greys of free, unknown and occupied cells; a pixel takes the darkest of its cells, so that walls remain.
_FREE, _UNKNOWN, _OCCUPIED = 255, 205, 60


def thumbnail(unknown: np.ndarray, occupied: np.ndarray) -> bytes:
    """Return a PNG of a map, given its (H, W) masks, with row 0 at the bottom; empty for a map without cells."""
    if not occupied.size:
        return b""
    grey = np.full(occupied.shape, _FREE, np.uint8)
    grey[unknown] = _UNKNOWN
    grey[occupied] = _OCCUPIED
    step = -(-max(occupied.shape) // WIDEST)
    for axis in (0, 1):
        grey = np.minimum.reduceat(grey, np.arange(0, grey.shape[axis], step), axis=axis)
    return grey_png(grey[::-1])
