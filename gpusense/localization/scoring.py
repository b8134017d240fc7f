"""Scores of a filter's particles by readings of its sensors, call by call or as part of one recorded program."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from gpusense._util import checks
from gpusense.interface.launches import Program
from gpusense.localization.cloud import Cloud
from gpusense.localization.sensors import Sensor

# Index of a sensor, and its readings.
Given = tuple[int, tuple[Any, ...]]


def given_of(readings: Any, sensors: Sequence[Sensor]) -> list[Given]:
    """Return the readings that are not missing, in the order of the sensors.

    Args:
        readings: The reading of the only sensor, or a mapping from models to theirs.
        sensors: The sensors.

    Raises:
        KeyError: a model that is not among the sensors'.
        TypeError: several sensors, and no mapping.
    """
    if isinstance(readings, Mapping):
        index = {id(sensor.model): i for i, sensor in enumerate(sensors)}
        for model in readings:
            if id(model) not in index:
                raise KeyError(f"readings: must be of the filter's models, got those of {checks.show(model)}")
        pairs = sorted((index[id(model)], value) for model, value in readings.items() if value is not None)
    elif len(sensors) > 1:
        raise TypeError(f"readings: must be a mapping from models to their readings, got {checks.show(readings)}")
    else:
        pairs = [] if readings is None else [(0, readings)]
    return [(i, value if isinstance(value, tuple) else (value,)) for i, value in pairs]


class Scoring:
    """Scores the particles of a cloud.

    Args:
        cloud: The particles.
        sensors: The sensors of the filter.

    Attributes:
        timed: Whether to wait for the log-likelihoods of each stage, so that their time is known.
    """

    timed = False

    def __init__(self, cloud: Cloud, sensors: Sequence[Sensor]) -> None:
        self._cloud, self._sensors, self._backend = cloud, sensors, cloud.backend

    def records(self, given: Sequence[Given]) -> bool:
        """Tell whether a step with such readings is one recorded program: on a GPU that can score all of them."""
        gpu = self._backend.info.kind == "gpu"
        return gpu and all(self._sensors[index].records(reading) for index, reading in given)

    def correct(self, given: Sequence[Given], kind: int, stages: int, drawn: int) -> int:
        """Run a step, and return the number of particles drawn.

        Args:
            given: Indices of sensors with their readings.
            kind: Kind of the motion that begins the step.
            stages: Most stages.
            drawn: Particles of the next step.
        """
        cloud = self._cloud
        if self.records(given):
            for index, reading in given:
                self._sensors[index].upload(reading)
            key = (tuple((index, self._sensors[index].version) for index, _ in given), cloud.count)
            cloud.replay(kind, stages, drawn, key, lambda source: self._program(source, given))
            return drawn
        return cloud.correct(
            kind, stages, drawn, len(given), lambda source, before: self._score(source, before, given)
        )

    def _score(self, source: int, before: Program, given: Sequence[Given]) -> None:
        """Start the log-likelihoods of poses that launches write."""
        poses = self._poses(source)
        for place, (index, reading) in enumerate(given):
            self._sensors[index].score(poses, reading, self._log_p(place), before, timed=self.timed)
            before = ()

    def _program(self, source: int, given: Sequence[Given]) -> tuple[Program, object]:
        """Return the launches that score the poses of a buffer, and the owners of their memory."""
        program: Program = ()
        owners: list[object] = []
        self._cloud.use(len(given))
        poses = self._poses(source)
        for place, (index, _) in enumerate(given):
            out = self._log_p(place)
            launches, owner = self._sensors[index].program(poses, out)
            program += launches
            owners.append((poses, out, owner))
        return program, owners

    def _poses(self, source: int) -> Any:
        return self._backend.view(self._cloud.poses[source], (self._cloud.count, 3), np.dtype(np.float64))

    def _log_p(self, place: int) -> Any:
        """Return the array for a sensor's log-likelihoods."""
        return self._backend.view(self._cloud.log_p[place], (self._cloud.count,), self._cloud.precision)
