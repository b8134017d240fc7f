"""A filter's particles on the device of its sensors, scored call by call or within a recorded program."""

from __future__ import annotations

import functools
from collections.abc import Hashable, Mapping, Sequence
from typing import Any

import numpy as np

from gpusense._util import checks
from gpusense.backends.base import Buffer
from gpusense.backends.workspace import ProgramCache
from gpusense.interface.launches import Program
from gpusense.localization.beam_consistency import JUDGED, MapJudge
from gpusense.localization.cloud import Cloud
from gpusense.localization.cloud_state import SensorReadings, Step
from gpusense.localization.particles import Stage
from gpusense.localization.sensors import Sensor

# Most cached programs.
_MOST_PROGRAMS = 8
_MOST_VIEWS = 32
_DOUBLE = np.dtype(np.float64)


def readings_of(readings: Any, sensors: Sequence[Sensor]) -> list[SensorReadings]:
    """Return the valid readings in the order of the sensors.

    A tuple that begins with an array holds several arguments of a reading; any other tuple is an array.
    """
    if type(readings) is np.ndarray and len(sensors) == 1:
        return [(0, (readings,))]
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
    several = [(i, value if _is_several(value) else (value,)) for i, value in pairs]
    # Convert lists to arrays, to refuse ragged ones by name.
    return [
        (i, tuple(checks.as_array("readings", part, masked=True) if isinstance(part, list) else part for part in value))
        for i, value in several
    ]


def _is_several(value: Any) -> bool:
    """Return whether a reading is a tuple of arguments: its first item is an array, not a number."""
    return isinstance(value, tuple) and len(value) > 0 and (isinstance(value[0], list) or np.ndim(value[0]) > 0)


def copied(part: Any) -> Any:
    """Return a copy of a NumPy array, and any other part of a reading unchanged."""
    return part.copy() if isinstance(part, np.ndarray) else part


class FilterCloud(Cloud):
    """Particles of a filter on the device of its sensors.

    Steps never write buffers named in ``kept``, and finally name the new buffers in ``places``. Restoring the
    attributes in ``MEMORY`` therefore undoes an interrupted call of a filter.
    """

    def __init__(self, sensors: Sequence[Sensor], capacity: int, *, residual: bool = False) -> None:
        readings = [sensor.readings for sensor in sensors]
        super().__init__(sensors[0].backend, capacity, readings, sensors[0].precision, residual=residual)
        self._scored = sensors
        self._programs = ProgramCache[tuple[Program, object]](_MOST_PROGRAMS)
        # Views of buffers for models, by the number of particles.
        self._views: dict[tuple[str, int, int], Any] = {}

    def correct(self, step: Step) -> None:
        """Run a correction."""
        gpu, readings, given = self.backend.info.kind == "gpu", step.readings, None
        if gpu and all(self._scored[index].records(reading) for index, reading in readings):
            given, score = functools.partial(self._give, step), functools.partial(self._replay, readings)
        else:
            score = functools.partial(self._call, readings)
        stages = self.places.stages(self.kept, step.stages, step.drawn, step.kind, same=step.drawn == self.count)
        judges = functools.partial(self._judges_of, step.judged) if step.judged else None
        self.run_stages(step.settings, stages, step.drawn, len(readings), score, judges, step.meanwhile, given)

    def _give(self, step: Step) -> None:
        """Set the inputs of a recorded correction."""
        self._given, adopted = np.empty(self.inputs.size), []
        self._given[self.inputs.spans[0]] = step.settings
        for index, reading in step.readings:
            target = self.readings[index]
            source = self._scored[index].place(reading, self._given[self.inputs.spans[1 + index]], target)
            if source is not None:
                adopted.append((source, target, self._scored[index].readings * _DOUBLE.itemsize))
        self._adopted = adopted

    def _judges_of(self, judged: Sequence[SensorReadings]) -> list[MapJudge]:
        """Prepare and return the judges of scans, whose beams become inputs of the correction."""
        result = list[MapJudge]()
        for index, (ranges, *_) in judged:
            judge, place, given = self._scored[index].judge(), len(result), self._given
            scan = np.empty(JUDGED) if given is None else given[self.inputs.spans[1 + len(self.readings) + place]]
            if judge.expects(self._scored[index].model.scanner, ranges, scan):
                result.append(judge)
                if given is None:
                    self.backend.refill(self._held(scan), self.scans[place])
        return result

    def _call(self, readings: Sequence[SensorReadings], stage: Stage) -> None:
        """Start the log-likelihoods of a stage call by call, and weigh."""
        poses = self._poses(stage.source)
        before = None if stage.kind is None else functools.partial(self.begin, stage)
        for place, (index, reading) in enumerate(readings):
            self._scored[index].score(poses, reading, self._log_p(place), before=before)
            before = None
        self.weigh(stage)

    def _replay(self, readings: Sequence[SensorReadings], stage: Stage) -> None:
        """Run a stage as one recorded program."""
        key = (tuple((index, self._scored[index].version) for index, _ in readings), self.count)
        self.replay(stage, key, functools.partial(self._program, key, readings))

    def _program(self, key: Hashable, readings: Sequence[SensorReadings], source: int) -> tuple[Program, object]:
        """Return the launches that score the poses of a buffer, and the owners of their memory."""
        kept = self._programs.get((key, source))
        if kept is not None:
            return kept
        program: Program = ()
        owners: list[object] = []
        poses = self._poses(source)
        for place, (index, _) in enumerate(readings):
            out = self._log_p(place)
            launches, owner = self._scored[index].program(poses, self.readings[index], out)
            program += launches
            owners.append((poses, out, owner))
        return self._programs.keep((key, source), (program, owners))

    def _poses(self, source: int) -> Any:
        key = ("poses", source, self.count)
        return self._views.get(key) or self._view(key, self.poses[source], (self.count, 3), _DOUBLE)

    def _log_p(self, place: int) -> Any:
        """Return the array for a sensor's log-likelihoods."""
        key = ("log_p", place, self.count)
        return self._views.get(key) or self._view(key, self.log_p[place], (self.count,), self.precision)

    def _view(self, key: tuple[str, int, int], buffer: Buffer, shape: tuple[int, ...], dtype: np.dtype) -> Any:
        """Return a cached view of a buffer; clouds of one size have few views."""
        if len(self._views) >= _MOST_VIEWS:
            self._views.clear()
        self._views[key] = self.backend.view(buffer, shape, dtype)
        return self._views[key]
