"""Wrap a measurement model as a filter's sensor: device, readings on the device, and temperature."""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from gpusense._util import checks
from gpusense.backends import arrays
from gpusense.backends.base import Backend, Buffer
from gpusense.interface.constants import DEPTH, TEMPERATURE
from gpusense.interface.launches import Program
from gpusense.localization.beam_consistency import MapJudge
from gpusense.localization.defaults import DEFAULTS
from gpusense.localization.temperature import BeamCorrelation, axes_of, poses_around
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


class Lesson(NamedTuple):
    """A scan that teaches the temperature."""

    terms: Any  # (7, K) terms of its readings at :func:`poses_around` the estimate, or the function that waits for them
    axes: np.ndarray  # (3, 3) steps between these poses
    directions: np.ndarray  # (K,) directions of the beams in the world [rad]
    follows: bool  # whether the scan directly follows the previous lesson


class Sensor:
    """Measurement model of a filter."""

    MEMORY = ("_correlation", "_seen", "_learned", "_lesson")

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
        self._correlation = BeamCorrelation()
        # A temperature and its correlation; learning replaces the correlation.
        self._known: tuple[BeamCorrelation, float] | None = None
        self._seen, self._learned = 0, -1
        self._lesson: Lesson | None = None
        # The readings, the poses and the call that scores the readings around an estimate, or no call; the reading
        # on the device, its buffer, and its values if they came from the host.
        self._terms: tuple[Buffer, Buffer, RecordedCall | None] | None = None
        self._uploaded: object = None
        self._ranges: Buffer = None
        self._values: np.ndarray | None = None
        self._sent: list[np.ndarray] = []
        self._judge: MapJudge | None = None
        self._started = 0

    def temperature(self, chosen: float | str) -> float:
        """Return the present temperature of the log-likelihood, for the option ``chosen``."""
        if not self.calibrates:
            return 1.0
        if not isinstance(chosen, str):
            return chosen
        if self._known is None or self._known[0] is not self._correlation:
            self._known = self._correlation, self._correlation.temperature(self.beams)
        return self._known[1]

    def restart(self) -> None:
        """Reset the count of scans, and drop the lesson."""
        self._seen, self._learned, self._lesson = 0, -1, None

    @property
    def due(self) -> bool:
        """Return whether to learn the correlation of beams from the last scan: each of the first, then two in 25.

        A lesson takes as long as a step on a GPU, so fewer than a tenth of the steps have one.
        """
        return self._seen <= DEFAULTS.calibrations or self._seen % 25 <= 1

    def count(self) -> None:
        """Count a scan."""
        self._seen += 1

    def begin_lesson(self, pose: np.ndarray, covariance: np.ndarray, reading: tuple[Any, ...]) -> None:
        """Start scoring the last counted scan around the estimated pose, for ``learn`` in the next correction."""
        axes = axes_of(covariance)
        terms = self._start_terms(poses_around(pose, axes), reading)
        follows = self._learned == self._seen - 1
        self._lesson = Lesson(terms, axes, self.model.scanner.bearings + pose[2], follows)
        self._learned = self._seen

    def _start_terms(self, poses: np.ndarray, reading: tuple[Any, ...]) -> np.ndarray | Callable[[], np.ndarray]:
        """Return (7, K) terms of a scan's readings, or the function that waits for terms that the device computes."""
        if not self.records(reading):
            return self.parts(poses, reading)
        backend = self.backend
        if self._uploaded is not reading:
            self._upload(reading)
        if self._terms is None or self._terms[0] is not self._ranges:
            around, count = backend.empty_external(poses.size, _DOUBLE), len(poses)
            ranges = backend.view(self._ranges, (self.readings,), _DOUBLE)
            out = backend.view(backend.empty_external(count, self.precision), (count,), self.precision)
            call = self.model.bind_terms(backend.view(around, poses.shape, _DOUBLE), ranges, out)
            self._terms = self._ranges, around, call
        _, around, call = self._terms
        if call is None:
            return self.parts(poses, reading)
        backend.begin_batch()
        try:
            self._send(poses, around)
            call.begin()
        finally:
            backend.end_batch()
        # The terms that were read stay: a repeated correction reads them again, after the buffers have changed.
        return functools.cache(functools.partial(self._read_terms, call, self._values))

    def _read_terms(self, call: RecordedCall, ranges: np.ndarray | None) -> np.ndarray:
        """Wait for the terms of a scan's readings, and return them."""
        if ranges is None:
            ranges = self.backend.download(self._ranges, np.empty(self.readings))
        return call.terms(ranges)

    def receive(self) -> None:
        """Copy the terms of a started lesson to the host, before the buffers are used again."""
        self._uploaded, lesson = None, self._lesson
        if lesson is not None and callable(lesson.terms):
            self._lesson = lesson._replace(terms=np.asarray(lesson.terms(), np.float64))

    def learn(self, *, doubted: bool) -> None:
        """Learn the correlation of beams from the received lesson, or drop it if its pose is doubted by now."""
        if doubted:
            self._lesson, self._learned = None, -1
        elif self._lesson is not None:
            # A new object, since the correlation is part of the state.
            correlation = copy.copy(self._correlation)
            terms, axes, directions, follows = self._lesson
            correlation.add(terms, axes, directions, follows=follows)
            self._correlation, self._lesson = correlation, None

    def judge(self) -> MapJudge:
        """Return the present map on the device for judging beams, copied on first use."""
        if self._judge is None or self._judge.grid is not self.model.grid:
            self._judge = MapJudge(self.backend, self.model.grid)
        return self._judge

    def parts(self, poses: np.ndarray, reading: tuple[Any, ...]) -> np.ndarray:
        """Return (N, K) log-likelihoods of the beams of a scan, in float64."""
        return np.asarray(self.model.log_likelihood(poses, *reading, per_beam=True)[1], np.float64)

    def log_likelihood(self, poses: Any, reading: tuple[Any, ...]) -> Any:
        """Return the log-likelihoods of poses."""
        return self.model.log_likelihood(poses, *reading)

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

    @property
    def version(self) -> int:
        """Version of the map's table, a key of recorded programs."""
        return self.model.table_version if self.calibrates else 0

    def place(self, reading: tuple[Any, ...], values: np.ndarray, buffer: Buffer) -> Buffer | None:
        """Write the ranges of a scan to ``values``, which the caller copies to ``buffer``.

        Float64 ranges on the device are returned instead, and the caller copies them to ``buffer``.
        """
        ranges, self._uploaded, self._ranges, self._values = reading[0], reading, buffer, None
        if type(ranges) is not np.ndarray:
            if arrays.on_device(ranges) and self.backend.reads(ranges):
                adopted = self.backend.adopt(ranges, "ranges")
                if adopted.dtype == _DOUBLE and adopted.shape == (self.readings,) and adopted.contiguous:
                    return adopted.buffer
            ranges = arrays.copied_to_host(ranges, self.backend, "ranges")
        checked = checks.array("ranges", ranges, (self.readings,), finite=False, dtype=None)
        values[...] = float64_readings(checked, self.model.scanner)
        self._values = values
        return None

    def _upload(self, reading: tuple[Any, ...]) -> None:
        """Copy the ranges of a scan to the device outside of a recorded correction."""
        buffer = self.backend.empty_external(self.readings, _DOUBLE) if self._ranges is None else self._ranges
        values = np.empty(self.readings)
        source = self.place(reading, values, buffer)
        if source is None:
            self._send(values, buffer)
        else:
            self.backend.copy(source, buffer, values.nbytes)

    def _send(self, array: np.ndarray, buffer: Buffer) -> None:
        """Start copying an array that does not change, and keep it alive until the device has read it."""
        if len(self._sent) >= _MOST_STARTED:
            self.backend.synchronize()
            self._sent.clear()
        self._sent.append(array)
        self.backend.upload(array, buffer, wait=False)

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
