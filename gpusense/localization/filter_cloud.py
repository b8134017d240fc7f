"""Score a filter's particles on a device by its sensors."""

from __future__ import annotations

import functools
from collections.abc import Sequence

from gpusense.localization.cloud import Cloud
from gpusense.localization.cloud_state import SensorReadings, Step
from gpusense.localization.map_judge import MapJudge
from gpusense.localization.scoring import FilterScoring
from gpusense.localization.sensors import Sensor


class FilterCloud(Cloud):
    """Particles of a filter on the device of its sensors.

    Steps never write buffers named in ``kept``, and finally name the new buffers in ``places``. Restoring the
    attributes in ``MEMORY`` therefore undoes an interrupted call of a filter.

    Args:
        sensors: The sensors of the filter.
        capacity: Most particles.
        residual: Whether to draw by residual resampling.
    """

    def __init__(self, sensors: Sequence[Sensor], capacity: int, *, residual: bool = False) -> None:
        super().__init__(sensors[0].backend, capacity, len(sensors), sensors[0].precision, residual=residual)
        self._scored, self._scoring = sensors, FilterScoring(sensors)

    def correct(self, step: Step) -> None:
        """Run a correction."""
        score = self._scoring.of(self, step.readings)
        stages = self.places.stages(self.kept, step.stages, step.drawn, step.kind, same=step.drawn == self.count)
        judges = functools.partial(self._judges_of, step.judged) if step.judged else None
        self.run_stages(step.settings, stages, step.drawn, len(step.readings), score, judges)

    def _judges_of(self, judged: Sequence[SensorReadings]) -> list[MapJudge]:
        """Prepare and return the judges of scans."""
        sensors = ((self._scored[index], reading[0]) for index, reading in judged)
        return [judge for sensor, ranges in sensors if (judge := sensor.judge()).expects(sensor.model.scanner, ranges)]

    @property
    def scoring_seconds(self) -> float:
        """Seconds of all log-likelihoods; 0 where a step is one recorded program."""
        return sum(sensor.seconds for sensor in self._scored)

    def time_scoring(self) -> None:
        """Wait for the log-likelihoods of each stage from now on, for ``scoring_seconds``."""
        self._scoring.timed = True
