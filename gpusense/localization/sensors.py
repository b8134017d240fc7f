"""Wrap a measurement model as a filter's sensor: device, readings on the device, and temperature."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from gpusense._util import checks
from gpusense.backends import arrays
from gpusense.backends.base import Backend, Buffer
from gpusense.interface.constants import DEPTH, TEMPERATURE
from gpusense.interface.launches import Program
from gpusense.localization.beam_consistency import MapJudge
from gpusense.localization.lessons import Learner
from gpusense.models.landmark.base import FeatureModel
from gpusense.models.point.base import PointModel
from gpusense.models.scan.bound import RecordedCall
from gpusense.models.scan.model import ScanModel
from gpusense.tables.world_map import check_one_map
from gpusense.world.grid import OccupancyGrid
from gpusense.world.scanner import float64_readings

# Index of a sensor, and its readings.
SensorReadings = tuple[int, tuple[Any, ...]]
_DOUBLE = np.dtype(np.float64)
# Most queued calls before the host waits.
_MOST_STARTED = 64
_MOST_SENSORS = DEPTH - TEMPERATURE


class Sensor:
    """Measurement model of a filter."""

    def __init__(self, model: Any) -> None:
        if not isinstance(model, (ScanModel, PointModel)):
            raise TypeError(f"models: must be measurement models, got {checks.show(model)}")
        if isinstance(model, ScanModel) and model.temperature != 1:
            raise ValueError(f"models: must have temperature 1, the filter has its own, got {model.temperature}")
        self.model: Any = model
        # True if temperature="auto" learns from this sensor; true if its likelihood may have several peaks among
        # concentrated particles, for example exchangeable landmarks.
        self.calibrates, self.ambiguous = isinstance(model, ScanModel), isinstance(model, FeatureModel)
        self.backend: Backend = model.backend
        self.precision = np.dtype(model.precision)
        # Used beams and all beams of a scan; 0 for other models.
        self.beams = model.used_beams if isinstance(model, ScanModel) else 0
        self.readings = model.scanner.count if isinstance(model, ScanModel) else 0
        # The temperature of scans; None for other models.
        self.learner = Learner(model) if isinstance(model, ScanModel) else None
        # The last reading placed for a recorded step, and its values if they came from the host.
        self._placed: tuple[object, np.ndarray | None] = None, None
        self._judge: MapJudge | None = None
        self._started = 0

    def temperature(self, chosen: float | str) -> float:
        """Return the present temperature of the log-likelihood, for the option ``chosen``."""
        if self.learner is None:
            return 1.0
        return self.learner.temperature if isinstance(chosen, str) else chosen

    def begin_lesson(self, pose: np.ndarray, covariance: np.ndarray, reading: tuple[Any, ...]) -> None:
        """Begin to learn from the last scan at the estimated pose."""
        if self.learner is not None:
            ranges = self.values_of(reading).copy() if self.records(reading) else None
            self.learner.begin(pose, covariance, reading, ranges)

    def values_of(self, reading: tuple[Any, ...]) -> np.ndarray:
        """Return the ranges of a scan on the host, in float64."""
        placed, values = self._placed
        if placed is reading and values is not None:
            return values
        ranges = np.asarray(arrays.copied_to_host(reading[0], self.backend, "ranges"))
        return float64_readings(ranges, self.model.scanner)

    def judge(self) -> MapJudge:
        """Return the present map on the device for judging beams, copied on first use."""
        if self._judge is None or self._judge.grid is not self.model.grid:
            self._judge = MapJudge(self.backend, self.model.grid)
        return self._judge

    def score(
        self,
        poses: Any,
        reading: tuple[Any, ...],
        out: Any,
        before: Callable[[], None] | None = None,
    ) -> None:
        """Start writing the log-likelihoods of (N, 3) poses on the device to (N,) ``out``.

        ``before`` starts the launches that write the poses.
        """
        if self.calibrates:
            if np.ndim(reading[0]) != 1:
                raise ValueError(
                    f"ranges: must be those of one scan, ({self.model.scanner.count},), got {np.shape(reading[0])}"
                )
            self.model.start_scoring(poses, *reading, out=out, before=before)
            self._started += 1
            # Keep arrays alive until the device has read them.
            if self._started >= _MOST_STARTED:
                self.model.finish_scoring()
                self._started = 0
        else:
            if before is not None:
                before()
            self.model.log_likelihood(poses, *reading, out=out)

    # ---- recorded steps

    def records(self, reading: tuple[Any, ...]) -> bool:
        """Return whether a recorded program can score the reading: a scan on the host or on the device."""
        return self.calibrates and len(reading) == 1 and not self.model.compat

    def place(self, reading: tuple[Any, ...], values: np.ndarray) -> Buffer | None:
        """Write the ranges of a scan to ``values``, which the caller copies to the device.

        Float64 ranges on the device are returned instead, for a copy there.
        """
        ranges, self._placed = reading[0], (reading, None)
        plain = type(ranges) is np.ndarray
        if plain and ranges.dtype == _DOUBLE and ranges.shape == (self.readings,):
            values[...] = ranges
            self._placed = reading, values
            return None
        if not plain:
            if arrays.on_device(ranges) and self.backend.reads(ranges):
                adopted = self.backend.adopt(ranges, "ranges")
                if adopted.dtype == _DOUBLE and adopted.shape == (self.readings,) and adopted.contiguous:
                    return adopted.buffer
            ranges = arrays.copied_to_host(ranges, self.backend, "ranges")
        checked = checks.array("ranges", ranges, (self.readings,), finite=False, dtype=None)
        values[...] = float64_readings(checked, self.model.scanner)
        self._placed = reading, values
        return None

    def program(self, poses: Any, buffer: Buffer, out: Any) -> tuple[Program, object]:
        """Return the launches for scoring poses by readings on the device, and the owner of their memory."""
        ranges = self.backend.view(buffer, (self.readings,), _DOUBLE)
        call = self.model.bind(poses, ranges, out=out)
        if not isinstance(call, RecordedCall):
            raise RuntimeError(f"the model's call cannot be recorded: {call.explain()}")
        return call.program, (call, ranges)


def sensors_of(models: Any) -> list[Sensor]:
    """Return the sensors of one or several models with a common device and precision."""
    chosen = list(models) if isinstance(models, Sequence) else [models]
    if not 0 < len(chosen) <= _MOST_SENSORS:
        raise ValueError(f"models: must be 1 to {_MOST_SENSORS} measurement models, got {len(chosen)}")
    if len({id(model) for model in chosen}) < len(chosen):
        raise ValueError("models: must be different ones, since readings are found by their model, got one twice")
    for model in chosen:
        check_one_map("models", model)
    sensors = [Sensor(model) for model in chosen]
    backend = sensors[0].backend
    if any(sensor.backend is not backend for sensor in sensors):
        names = ", ".join(sorted({sensor.backend.info.selection for sensor in sensors}))
        raise ValueError(f"models: must be of one device, got {names}")
    if len({sensor.precision for sensor in sensors}) > 1:
        raise ValueError("models: must have one precision, got float32 and float64")
    if not backend.info.float64:
        raise ValueError(f"models: must be on a device with float64, got {backend.info.name}")
    return sensors


def grid_of(sensors: Sequence[Sensor]) -> OccupancyGrid | None:
    """Return the map of the first sensor that has one."""
    return next((sensor.model.grid for sensor in sensors if hasattr(sensor.model, "grid")), None)


def readings_of(readings: Any, sensors: Sequence[Sensor]) -> list[SensorReadings]:
    """Return copies of the valid readings in the order of the sensors, since the caller may reuse their arrays.

    A tuple that begins with an array holds several arguments of a reading; any other tuple is an array.
    """
    if type(readings) is np.ndarray and len(sensors) == 1:
        return [(0, (readings.copy(),))]
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
    return [(i, tuple(map(_copied, value))) for i, value in several]


def _is_several(value: Any) -> bool:
    """Return whether a reading is a tuple of arguments: its first item is an array, not a number."""
    return isinstance(value, tuple) and len(value) > 0 and (isinstance(value[0], list) or np.ndim(value[0]) > 0)


def _copied(part: Any) -> Any:
    """Return a copy of a NumPy array or of a list as an array, which refuses ragged ones by name."""
    if isinstance(part, list):
        return checks.as_array("readings", part, masked=True)
    return part.copy() if isinstance(part, np.ndarray) else part
