"""Calibration of a filter's sensors while it runs: how much the beams of its scans are worth."""

from __future__ import annotations

from collections.abc import Sequence

from gpusense.localization import skipping
from gpusense.localization.cloud import Cloud
from gpusense.localization.estimates import covariance_of
from gpusense.localization.scoring import Given
from gpusense.localization.sensors import Sensor


def calibrate(sensors: Sequence[Sensor], given: Sequence[Given], cloud: Cloud, shown: int) -> None:
    """Learn from the scans of a correction at the estimated pose, if the particles lie together.

    Args:
        sensors: The filter's sensors.
        given: Indices of sensors with their readings.
        cloud: The particles after the correction.
        shown: Number of the particles that have weights.
    """
    due = []
    for index, reading in given:
        sensor = sensors[index]
        if sensor.calibrates:
            sensor.count()
            due += [(sensor, reading)] if sensor.due else []
    if not due or cloud.summary().effective_sample_size < 2:
        return
    numbers = cloud.estimate(shown)
    covariance = covariance_of(numbers)
    if max(covariance[0, 0], covariance[1, 1]) > skipping.TOGETHER**2:
        return
    for sensor, reading in due:
        sensor.correlate(numbers[:3], covariance, reading)
