"""Draw particles of starts and resets on the host, by the reference of the kernels' generator.

All backends draw equal particles. Sensor resetting: Lenser and Veloso, *Sensor resetting localization for poorly
modelled mobile robots* (2000).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from gpusense._util import checks
from gpusense._util.angles import wrapped
from gpusense.localization.sensors import Sensor
from gpusense.reference.philox import normal_pair, random_words, uniform_of
from gpusense.world.grid import OccupancyGrid
from gpusense.world.plausible import look_at_heading, look_at_start

Key = tuple[int, int, int]
Spread = tuple[float, float, float]
# Most poses of a pool; free cells of larger maps are thinned evenly.
_MOST_POOL = 1 << 18
# Stream of random numbers that no kernel uses.
_STREAM = 64
# Tried poses per new particle, and at least, in a reset; new particles per chosen pose.
_TRIES, _LEAST_TRIES, _SHARE = 10, 20_000, 10
# Half widths of the box around a chosen pose [m, m, rad].
_SPREAD = (0.1, 0.1, 0.05)


def _words(count: int, key: Key, stream: int) -> tuple[np.ndarray, ...]:
    zero = np.zeros(count, np.uint64)
    counter = (np.arange(count), zero + np.uint64(key[2]), zero + np.uint64(_STREAM + stream), zero)
    return random_words(counter, key[0], key[1])


def _wrapped(poses: np.ndarray) -> np.ndarray:
    poses[:, 2] = wrapped(poses[:, 2])
    return poses


def normal(mean: Any, covariance: Any, count: int, key: Key) -> np.ndarray:
    """Draw poses from a normal density."""
    centre, matrix = checks.array("mean", mean, (3,), largest=1e300), checks.array("covariance", covariance, (3, 3))
    if np.abs(matrix - matrix.T).max() > 1e-9 * max(np.abs(matrix).max(), 1e-300):
        raise ValueError("covariance: must be symmetric, got one that is not")
    values, vectors = np.linalg.eigh(matrix)
    if values.min() < -1e-9 * max(values.max(), 0.0):
        raise ValueError(f"covariance: must be positive semidefinite, got an eigenvalue of {values.min()}")
    words = _words(count, key, 0)
    one, two = normal_pair(words[0], words[1])
    three, _ = normal_pair(words[2], words[3])
    root = vectors * np.sqrt(np.maximum(values, 0))
    return _wrapped(centre + np.column_stack([one, two, three]) @ root.T)


def spread(pool: np.ndarray, half: Spread, count: int, key: Key, *, each: bool = False) -> np.ndarray:
    """Draw poses uniformly in boxes around (M, 3) centres, in turns with ``each`` and otherwise at random."""
    first, more = _words(count, key, 1), _words(count, key, 2)
    row = np.arange(count) % len(pool)
    if not each:
        row = np.minimum((uniform_of(first[0]) * len(pool)).astype(np.int64), len(pool) - 1)
    offsets = np.column_stack([2 * uniform_of(word) - 1 for word in more[:3]])
    return _wrapped(pool[row] + offsets * half)


def free_pool(models: Sequence[Any], bounds: Any) -> tuple[np.ndarray, Spread]:
    """Return the centres of free cells of the first map among the models, and half widths with any heading."""
    box = None if bounds is None else checks.array("bounds", bounds, (2, 2))
    grid = next((model.grid for model in models if hasattr(model, "grid")), None)
    if grid is None:
        if box is None:
            raise ValueError("bounds: must be given where no model has a grid, got None")
        half = (box[1] - box[0]) / 2
        return np.array([[*(box[0] + half), 0.0]]), (float(half[0]), float(half[1]), math.pi)
    rows, columns = np.nonzero(grid.free)
    centres = np.column_stack([grid.cell_centers(rows, columns), np.zeros(len(rows))])
    if box is not None:
        centres = centres[((centres[:, :2] >= box[0]) & (centres[:, :2] <= box[1])).all(axis=1)]
    if not len(centres):
        raise ValueError("map: must have a free cell to begin in, got none")
    if len(centres) > _MOST_POOL:
        centres = centres[np.arange(_MOST_POOL) * len(centres) // _MOST_POOL]
    half_cell = grid.resolution / 2
    return centres, (half_cell, half_cell, math.pi)


def rows_by_weight(weights: np.ndarray, count: int, start: float = 0.5) -> np.ndarray:
    """Draw indices systematically by weights, not necessarily normalised; the first mark is at ``start``."""
    ends = np.cumsum(weights)
    rows = np.searchsorted(ends, (np.arange(count) + start) / count * ends[-1], side="right")
    return np.minimum(rows, len(weights) - 1)


def likely_pool(likelihood: Any, count: int, key: Key) -> tuple[np.ndarray, Spread]:
    """Return poses drawn by their likelihood, and half widths of a cell of the likelihood's grid."""
    if not hasattr(likelihood, "log_p") or not (hasattr(likelihood, "poses") or hasattr(likelihood, "positions")):
        raise TypeError(f"likelihood: must be one of pose_likelihood, got {checks.show(likelihood)}")
    shape = np.shape(likelihood.log_p)
    log_p = np.asarray(likelihood.log_p, np.float64).reshape(-1)
    if not hasattr(likelihood, "poses") and np.size(likelihood.positions) != 3 * log_p.size:
        count = np.size(likelihood.positions) // 3
        raise ValueError(f"likelihood: positions must be those of log_p, got {count} for {log_p.size}")
    finite = np.isfinite(log_p)
    if not finite.any():
        raise ValueError("likelihood: must have a finite log_p, got none")
    weight = np.where(finite, np.exp(np.where(finite, log_p, -np.inf) - log_p[finite].max()), 0.0)
    rows = rows_by_weight(weight, count, float(uniform_of(_words(1, key, 3)[0])[0]))
    if hasattr(likelihood, "poses"):
        poses = likelihood.poses(*np.unravel_index(rows, shape))
    else:
        poses = np.asarray(likelihood.positions, np.float64).reshape(-1, 3)[rows]
    step, headings = float(getattr(likelihood, "resolution", 0.0)) / 2, np.size(getattr(likelihood, "headings", ()))
    return poses, (step, step, math.pi / headings if headings else 0.0)


def look_at(pose: np.ndarray, grid: OccupancyGrid | None) -> None:
    """Warn of an implausible start at a (3,) pose."""
    if grid is None:
        look_at_heading("start", float(pose[2]))
        return
    (place,), (rows, cols) = grid.world_to_cells(pose[None, :2]), grid.shape
    look_at_start(pose, bool(0 <= place[0] <= cols and 0 <= place[1] <= rows), grid.bounds())


def likeliest(
    random_poses: Callable[[int], np.ndarray],
    particles: int,
    sensors: Sequence[Sensor],
    readings: Mapping[int, tuple[Any, ...]],
    temperature: float | str,
) -> np.ndarray:
    """Return the likeliest of many random poses, the centres of a reset's draws."""
    count = max(particles // 2, 1)
    tries = random_poses(max(_LEAST_TRIES, _TRIES * count))
    score = np.zeros(len(tries))
    for index, reading in readings.items():
        sensor = sensors[index]
        score += sensor.temperature(temperature) * sensor.model.log_likelihood(tries, *reading)
    with np.errstate(invalid="ignore"):
        return np.asarray(tries[np.argsort(-score, kind="stable")[: max(count // _SHARE, 1)]])


def with_poses(particles: np.ndarray, poses: np.ndarray, key: Key) -> np.ndarray:
    """Replace half of the particles (N, 3) by draws around ``poses``, and return all particles."""
    count, result = max(len(particles) // 2, 1), particles.copy()
    result[:: max(len(particles) // count, 1)][:count] = spread(poses, _SPREAD, count, key, each=True)
    return result
