"""Calibration of a filter's sensors while it runs: how much the beams of its scans are worth."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from gpusense.localization.filter_cloud import Given
from gpusense.localization.sensors import Sensor
from gpusense.localization.skipping import TOGETHER

# Corrections after which a filter whose particles lie together looks whether they still do.
LOOK = 5
# A sensor, and the scan to learn from.
Due = list[tuple[Sensor, tuple[Any, ...]]]


def due_of(sensors: Sequence[Sensor], given: Sequence[Given]) -> Due:
    """Count the scans of a correction; return those to learn from, with their sensors.

    Args:
        sensors: The filter's sensors.
        given: Indices of sensors with their readings.
    """
    due = []
    for index, reading in given:
        sensor = sensors[index]
        if sensor.calibrates:
            sensor.count()
            due += [(sensor, reading)] if sensor.due else []
    return due


def is_together(covariance: np.ndarray) -> bool:
    """Tell whether particles of a covariance lie together: their deviation along x and along y is at most half a metre.

    Args:
        covariance: (3, 3) covariance of their poses [m, m, rad].
    """
    return bool(max(covariance[0, 0], covariance[1, 1]) <= TOGETHER**2)
