"""Class of a reading: a hit, a max reading, or missing (neither).

The limits are those of ``gpusense.world.scanner.range_limits``; NaN is missing by both comparisons.
"""

from __future__ import annotations

import numpy as np


def is_hit(reading: np.ndarray, nearest: float, farthest: float) -> np.ndarray:
    """Return which readings are ranges."""
    hit: np.ndarray = (reading >= nearest) & (reading < farthest)
    return hit


def is_max(reading: np.ndarray, farthest: float) -> np.ndarray:
    """Return which readings are "no return" (REP-117)."""
    far: np.ndarray = reading >= farthest
    return far
