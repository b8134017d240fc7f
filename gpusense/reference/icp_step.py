"""Steps of point-to-line ICP that scalar bodies and bodies in lanes share.

They find places among the bearings of a scan, solve the normal equations, and sum blocks of points.

Blocks: Flyvbjerg and Petersen (1989), "Error estimates on averages of correlated data".
"""

from __future__ import annotations

import numpy as np

FULL_TURN = 6.283185307179586
# Blocks have 1, 2, 4 to 2^(MATCH_BLOCKS - 1) points.
MATCH_BLOCKS = 8


def bearing_of(place: np.ndarray) -> np.ndarray:
    """Return the bearings of (N, 2) places in [0, 2 pi)."""
    bearing = np.arctan2(place[:, 1], place[:, 0])
    return np.where(bearing < 0, bearing + place.dtype.type(FULL_TURN), bearing)


def points_before(point: np.ndarray, bearing: np.ndarray) -> np.ndarray:
    """Return, for each bearing, the number of points of a scan with smaller bearings."""
    return np.searchsorted(point[:, 2], bearing, side="left")


def solve(information: np.ndarray, gradient: np.ndarray) -> np.ndarray | None:
    """Solve the damped normal equations: the step in x, y and theta, None without one."""
    real = information.dtype.type
    damped = information.copy()
    damping = real(1e-5) * (damped[0, 0] + damped[1, 1]) + real(1e-9)
    damped[0, 0] += damping
    damped[1, 1] += damping
    damped[2, 2] = damped[2, 2] * real(1.00001) + real(1e-9)
    try:
        factor = np.linalg.cholesky(damped)
    except np.linalg.LinAlgError:
        return None
    return np.linalg.solve(factor.T, np.linalg.solve(factor, gradient)).astype(real)


def block_squares(number: np.ndarray) -> np.ndarray:
    """Return for blocks of 1, 2, 4 to 128 successive points the sum of squares of the blocks' sums of numbers."""
    padded = np.append(number, np.zeros(-len(number) % (1 << (MATCH_BLOCKS - 1)), number.dtype))
    return np.array([np.square(padded.reshape(-1, 1 << level).sum(axis=1)).sum() for level in range(MATCH_BLOCKS)])
