"""Find the true posterior of a scan on a fine grid of poses, from coarse to fine."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gpusense.localization.weights import normalize_weights

Floats = NDArray[np.float64]

HALF = (0.3, 0.3, 0.15)
"""Half widths of the first grid [m, m, rad]."""
SIDE = 13
"""Poses along each axis."""
# The grid is fine enough if each deviation is at least this many spacings; it spans this many deviations on each side.
_FINE, _SPAN = 1.0, 5.0
_ROUNDS = 10


@dataclass(frozen=True)
class FinePosterior:
    """Poses of a regular grid with their exact log-likelihoods.

    Attributes:
        poses: (M, 3) poses [m, m, rad].
        log_p: (M,) log-likelihoods.
        deviation: (3,) standard deviations of the posterior [m, m, rad].
    """

    poses: Floats
    log_p: Floats
    deviation: Floats


def fine_posterior(score: Callable[[Floats], NDArray[np.floating]], pose: ArrayLike) -> FinePosterior:
    """Find the posterior near a pose, with a uniform prior.

    The first grid is 0.6 m wide. While a standard deviation is below the grid's spacing, the next grid is narrower and
    lies around the mean.

    ``score``: Returns the log-likelihoods of (M, 3) poses, finite. ``pose``: (3,) pose at the middle of the first grid
    [m, m, rad].
    """
    middle, half = np.asarray(pose, np.float64), np.array(HALF)
    steps = np.linspace(-1.0, 1.0, SIDE)
    unit = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    for _ in range(_ROUNDS):
        spacing, poses = 2 * half / (SIDE - 1), middle + unit * half
        log_p = np.asarray(score(poses), np.float64)
        weights = normalize_weights(log_p).weights
        mean = weights @ poses
        deviation = np.sqrt(weights @ np.square(poses - mean))
        if (deviation >= _FINE * spacing).all():
            break
        middle, half = mean, np.minimum(_SPAN * np.maximum(deviation, 0.5 * spacing), half)
    return FinePosterior(poses, log_p, deviation)
