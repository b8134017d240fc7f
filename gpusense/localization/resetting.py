"""Sensor resetting: half of the particles move to poses at which the last readings are likely.

Lenser and Veloso, *Sensor resetting localization for poorly modelled mobile robots* (2000).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from gpusense.localization import starts
from gpusense.localization.sensors import Sensor

# Poses that are tried: for each new particle, and the fewest; new particles for each pose that is chosen of them.
_TRIES, _LEAST_TRIES, _SHARE = 10, 20_000, 10
# Half widths of the box around a chosen pose [m, m, rad].
_SPREAD = (0.1, 0.1, 0.05)


def replaced(particles: int) -> int:
    """Return how many particles get new poses."""
    return max(particles // 2, 1)


def tries_of(particles: int) -> int:
    """Return how many poses are tried."""
    return max(_LEAST_TRIES, _TRIES * replaced(particles))


def with_likely_poses(
    poses: np.ndarray,
    tries: np.ndarray,
    sensors: Sequence[Sensor],
    readings: Mapping[int, tuple[Any, ...]],
    temperature: float | str,
    key: starts.Key,
) -> np.ndarray:
    """Return particles half of which are drawn around the likeliest of other poses.

    Args:
        poses: (N, 3) particles.
        tries: (M, 3) poses anywhere.
        sensors: The filter's sensors.
        readings: Last readings by the index of their sensor.
        temperature: Temperature of scans, or "auto".
        key: Seed and step.
    """
    score = np.zeros(len(tries))
    for index, reading in readings.items():
        sensor = sensors[index]
        score += sensor.temperature(temperature) * sensor.log_likelihood(tries, reading)
    count = replaced(len(poses))
    with np.errstate(invalid="ignore"):
        best = np.argsort(-score, kind="stable")[: max(count // _SHARE, 1)]
    result = poses.copy()
    result[:: max(len(poses) // count, 1)][:count] = starts.spread(tries[best], _SPREAD, count, key, each=True)
    return result
