"""Alignment of two maps to a fraction of a cell: least squares between their smoothed cells (Lucas and Kanade 1981).

Both maps are smoothed over the cells that they know, m = (G * occupied) / (G * known) with a normal density G. The pose
minimises the mean of (m(T p) - m_local(p))^2 over the known cells p of the local map that lie near its obstacles, by
Levenberg's damped Gauss-Newton steps. m is interpolated between the centres of cells.
"""

from __future__ import annotations

import math

import numpy as np

from gpusense.world.grid import OccupancyGrid

# Deviation of the smoothing [cells of the global map], its reach in deviations, and least share of known cells.
_SIGMA, _REACH, _KNOWN = 0.7, 3.0, 1e-3
# A cell is left out if the shares of known cells around it differ by more than this: one of both maps ends there.
_UNLIKE = 0.15
# Most cells of the local map, iterations, and the step that ends them [cells, and cells at the mean lever].
_MOST, _ITERATIONS, _SMALL = 20_000, 20, 1e-4


def smoothed(occupied: np.ndarray, known: np.ndarray, sigma: float) -> tuple[np.ndarray, np.ndarray]:
    """Return shares of occupied among known cells near each cell (H, W), 0 where none is known, and of known cells."""
    from scipy.ndimage import gaussian_filter

    top, bottom = (
        gaussian_filter(image.astype(np.float64), sigma, mode="constant", radius=math.ceil(_REACH * sigma))
        for image in (occupied & known, known)
    )
    return np.divide(top, bottom, out=np.zeros_like(top), where=bottom > _KNOWN), bottom


class Alignment:
    """A local map that is aligned with a global one.

    ``xy`` (M, 2) are the centres of its known cells, row by row, around its middle [cells of the global map]; ``poses``
    (M, 3) of the middle will be refined [cells, cells, rad], by at most ``farthest`` [cells].
    """

    def __init__(
        self, local: OccupancyGrid, xy: np.ndarray, grid: OccupancyGrid, poses: np.ndarray, farthest: float
    ) -> None:
        ratio = grid.resolution / local.resolution
        values, shares = (image[~local.unknown] for image in smoothed(local.occupied, ~local.unknown, _SIGMA * ratio))
        near = np.flatnonzero(values)
        near = near if len(near) <= _MOST else near[np.arange(_MOST) * len(near) // _MOST]
        self._xy, self._values, self._shares = xy[near], values[near], shares[near]
        self._lever = max(float(np.sqrt(np.mean(self._xy**2))), 1.0)
        self._farthest = farthest
        # Keep only the part of the map that the cells can reach.
        reach = float(np.hypot(*self._xy.T).max()) + farthest + _REACH * _SIGMA + 2
        low, high = poses[:, :2].min(axis=0) - reach, poses[:, :2].max(axis=0) + reach
        first, end = (np.clip(np.round(edge), 0, grid.shape[::-1]).astype(int) for edge in (low, high))
        part = slice(first[1], end[1]), slice(first[0], end[0])
        # The margin gives cells at the border of the map neighbours on all sides.
        occupied, self._known = (np.pad(image[part], 1) for image in (grid.occupied, ~grid.unknown))
        self._corner = first - 1
        self._map, self._share = smoothed(occupied, self._known, _SIGMA)

    def refined(self, pose: np.ndarray, most: float) -> np.ndarray:
        """Return the best pose (3,) near a start, or the start if the optimum is too far or turned by too much."""
        at, damping = pose.astype(np.float64), 1e-3
        value, gradient, information = self._evaluated(at)
        for _ in range(_ITERATIONS):
            # As much damping along x as along y, so that ends turn with the map.
            diagonal = np.append(np.full(2, information.trace() - information[2, 2]) / 2, information[2, 2])
            damped = information + np.diag(damping * diagonal + 1e-9 * (1 + diagonal.max()))
            step = np.linalg.solve(damped, -gradient)
            trial = at + step
            new = self._evaluated(trial)
            if better := new[0] < value:
                at, (value, gradient, information) = trial, new
            damping = min(max(damping / 5 if better else damping * 8, 1e-6), 1e6)
            if max(math.hypot(*step[:2]), self._lever * abs(step[2])) < _SMALL:
                break
        moved = at - pose
        return at if math.hypot(*moved[:2]) <= self._farthest and abs(moved[2]) <= most else pose

    def _evaluated(self, pose: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Return the mean squared difference at a pose, half its gradient, and the mean information."""
        cos, sin = math.cos(pose[2]), math.sin(pose[2])
        x, y = self._xy.T
        turned = np.stack([cos * x - sin * y, sin * x + cos * y])
        # Cell (row, col) has its centre at (col + 0.5, row + 0.5).
        u, v = turned + (pose[:2] - self._corner - 0.5)[:, None]
        rows, cols = self._map.shape
        col, row = np.floor(u).astype(np.int64), np.floor(v).astype(np.int64)
        a, b = u - col, v - row
        inside = (col >= 0) & (col + 1 < cols) & (row >= 0) & (row + 1 < rows)
        place = np.where(inside, row * cols + col, 0)
        nearest = place + np.where(b < 0.5, 0, cols) + (a >= 0.5)
        unlike = np.abs(self._share.take(nearest) - self._shares)
        weight = np.where(inside & self._known.take(nearest), np.maximum(1 - unlike / _UNLIKE, 0), 0.0)
        if np.count_nonzero(weight) < 3:
            return math.inf, np.zeros(3), np.zeros((3, 3))
        m00, m01, m10, m11 = (self._map.take(place + next_place) for next_place in (0, 1, cols, cols + 1))
        error = (1 - b) * ((1 - a) * m00 + a * m01) + b * ((1 - a) * m10 + a * m11) - self._values
        along = (1 - b) * (m01 - m00) + b * (m11 - m10)
        up = (1 - a) * (m10 - m00) + a * (m11 - m01)
        numbers = np.stack([along, up, up * turned[0] - along * turned[1], error])
        # No matrix product: its last bits differ between processors.
        sums = np.array([[(weighted * other).sum() for other in numbers] for weighted in weight * numbers])
        sums /= weight.sum()
        return float(sums[3, 3]), sums[:3, 3], sums[:3, :3]
