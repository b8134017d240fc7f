"""The particles of a filter on one device, scored by its sensors."""

from __future__ import annotations

import functools
from collections.abc import Sequence

from gpusense.localization.cloud import Cloud
from gpusense.localization.filter_cloud import FilterCloud, SensorReadings, Step
from gpusense.localization.map_judge import MapJudge
from gpusense.localization.scoring import FilterScoring
from gpusense.localization.sensors import Sensor


class DeviceCloud(Cloud, FilterCloud):
    """Particles of a filter on the device of its sensors.

    Args:
        sensors: The sensors of the filter.
        capacity: Most particles.
        residual: Whether to draw by residual resampling.
    """

    def __init__(self, sensors: Sequence[Sensor], capacity: int, *, residual: bool = False) -> None:
        super().__init__(sensors[0].backend, capacity, len(sensors), sensors[0].precision, residual=residual)
        self._scored, self._scoring = sensors, FilterScoring(sensors)

    def correct(self, step: Step) -> None:
        score = self._scoring.of(self, step.readings)
        stages = self.places.stages(self.kept, step.stages, step.drawn, step.kind, same=step.drawn == self.count)
        judges = functools.partial(self._judges_of, step.judged) if step.judged else None
        self.run_stages(step.settings, stages, step.drawn, len(step.readings), score, judges)

    def _judges_of(self, judged: Sequence[SensorReadings]) -> list[MapJudge]:
        """Return the judges of scans, prepared for them."""
        sensors = ((self._scored[index], reading[0]) for index, reading in judged)
        return [judge for sensor, ranges in sensors if (judge := sensor.judge()).expects(sensor.model.scanner, ranges)]

    @property
    def scoring_seconds(self) -> float:
        """See FilterCloud.scoring_seconds; 0 where a step is one recorded program."""
        return sum(sensor.seconds for sensor in self._scored)

    def time_scoring(self) -> None:
        self._scoring.timed = True
