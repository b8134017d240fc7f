"""A part of a filter's particles on one device: it moves, scores, weighs and draws them.

Methods are generators that start work on the device before they yield and read its results after, so that one thread
keeps several devices busy. They take and return plain data, which crosses to other processes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from gpusense.backends.programs import ProgramCache, RecordedProgram
from gpusense.interface.constants import (
    DRAWN,
    ESTIMATE,
    ESTIMATE_LANES,
    ESTIMATE_SUMS,
    FIRST,
    SETTINGS,
    SHARE,
    TEMPERATURE,
    WEIGHT_SUMS,
    WHOLE,
)
from gpusense.interface.flags import flags_if
from gpusense.interface.launches import Program, launch
from gpusense.localization.cloud import Cloud
from gpusense.localization.distributed.parts import Marks, Part, Piece, SensorReadings, Step
from gpusense.localization.distributed.shard_pool import ShardPool
from gpusense.localization.particles import Places, Stage
from gpusense.localization.sensors import Sensor
from gpusense.reference.tempering import left_of, rung_of

# Units in the last place by which a factor is varied until a product has the wanted value.
_UNITS = 16
_DOUBLE = np.dtype(np.float64)
_MOST_RECORDED = 8


class Shard:
    """Particles on one device.

    Args:
        models: The filter's models on this device.
        capacity: Most particles of the shard.
        residual: Whether to draw by residual resampling.
    """

    def __init__(self, models: Sequence[Any], capacity: int, residual: bool) -> None:
        self._sensors = [Sensor(model) for model in models]
        self._backend = self._sensors[0].backend
        self._cloud = Cloud(self._backend, max(capacity, 16), len(self._sensors), self._sensors[0].precision)
        self._part = Part(0, 0, 0, 16)
        self._settings = np.zeros(0)
        self._pool, self._residual = ShardPool(self._backend), residual
        # With an array of ones, and an offset as the temperature in settings, the launch ``add_scores`` shifts
        # cumulative weights.
        self._ones: tuple[Any, Any] | None = None
        self._recordings = ProgramCache[RecordedProgram](_MOST_RECORDED)
        self._timed = False

    @property
    def _gpu(self) -> bool:
        return self._backend.info.kind == "gpu"

    # ---- beginnings

    def fill(self, arrays: Sequence[tuple[str, int, np.ndarray]]) -> Step:
        """Copy arrays to buffers, which are named by "poses" or "weights" and an index."""
        self._backend.synchronize()
        for name, index, array in arrays:
            if array.size:
                self._backend.upload(np.ascontiguousarray(array, np.float64), getattr(self._cloud, name)[index])
        yield

    def set_pool(self, poses: np.ndarray) -> Step:
        """Take over the poses from which recovery injects particles."""
        self._cloud.set_pool(poses)
        yield

    # ---- a step

    def begin(self, part: Part, settings: np.ndarray, origin: int, target: int, kind: int) -> Step:
        """Begin a step: move particles from a buffer to another.

        Args:
            part: The particles.
            settings: Settings of the whole filter's step.
            origin: Index of the poses before the move.
            target: Index of the poses after it.
            kind: Kind of the motion.
        """
        self._settings = settings.copy()
        self._set_part(part)
        self._upload_settings(part)
        if part.size:
            self._backend.run(self._cloud.motion(origin, target, kind))
        yield

    def _set_part(self, part: Part) -> None:
        self._part = part
        self._cloud.set_particles(Places(), part.size, part.block)

    def _upload_settings(self, drawn: Part, share: float | None = None) -> None:
        """Upload the settings of the step for a part's particles, with a different share if one is passed."""
        settings = self._settings.copy()
        settings[FIRST], settings[WHOLE], settings[DRAWN] = drawn.first, self._part.whole, drawn.whole
        if share is not None:
            settings[SHARE] = share
        self._backend.upload(settings, self._cloud.settings)

    def use_settings(self, settings: np.ndarray) -> Step:
        """Replace the settings of the step."""
        self._settings = settings.copy()
        self._upload_settings(self._part)
        yield

    def score(self, source: int, readings: Sequence[SensorReadings]) -> Step:
        """Score the poses of a buffer by readings, and return the largest score."""
        cloud, part = self._cloud, self._part
        if not part.size:
            yield
            return -math.inf
        if self._gpu and all(self._sensors[index].records(reading) for index, reading in readings):
            for index, reading in readings:
                self._sensors[index].upload(reading)
            self._recorded(source, readings).start()
        else:
            for place, (index, reading) in enumerate(readings):
                out = self._scores(place)
                self._sensors[index].score(self._poses(source), reading, out, timed=self._timed)
            self._backend.run(cloud.scoring(len(readings)))
        yield
        return float(self._read(cloud.sums.largest, cloud.blocks).max())

    def _recorded(self, source: int, readings: Sequence[SensorReadings]) -> RecordedProgram:
        """Return the recorded program that scores a buffer; starting it does not wait, so devices work concurrently."""
        sensors = tuple((index, self._sensors[index].version) for index, _ in readings)
        key = (source, self._part.size, self._part.block, sensors)
        kept = self._recordings.get(key)
        if kept is not None:
            return kept
        program: Program = ()
        poses, owners = self._poses(source), []
        for place, (index, _) in enumerate(readings):
            out = self._scores(place)
            launches, owner = self._sensors[index].program(poses, out)
            program += launches
            owners.append((out, owner))
        program += self._cloud.scoring(len(readings))
        return self._recordings.keep(key, RecordedProgram(self._backend, program, (poses, owners)))

    def _poses(self, source: int) -> Any:
        return self._backend.view(self._cloud.poses[source], (self._part.size, 3), _DOUBLE)

    def _scores(self, place: int) -> Any:
        return self._backend.view(self._cloud.log_p[place], (self._part.size,), self._cloud.precision)

    def weigh(self, high: float, stage: Stage) -> Step:
        """Return the sums of integer weights, given the largest score of the whole filter."""
        cloud, part = self._cloud, self._part
        if not part.size:
            yield
            return np.zeros(WEIGHT_SUMS)
        self._backend.upload(np.array([high]), cloud.sums.largest)
        self._backend.run(cloud.sums.weigh(cloud.numbers(stage), (cloud.sums.largest, 1), stage.number))
        yield
        return self._read(cloud.sums.totals, WEIGHT_SUMS)

    def set_weights(self, stage: Stage, totals: np.ndarray, state: np.ndarray, offset: float, marks: Marks) -> Step:
        """Set the weights from the sums and the state of the whole filter; return the particles that draws need.

        Args:
            stage: The stage.
            totals: Sums of the whole filter.
            state: State of the whole filter after this stage.
            offset: Sum of the weights of all preceding shards.
            marks: The lowest and the highest mark of each shard's draws; None where nothing is drawn.

        Returns:
            For each pair of marks, poses and cumulative weights of the particles between them.
        """
        cloud, part = self._cloud, self._part
        if part.size:
            self._choose_rung(totals, left_of(state, stage.number))
            self._backend.upload(totals, cloud.sums.totals)
            self._backend.run(cloud.setting(stage))
        yield
        # The kernel knows only the shard's number of particles; the state must have that of the whole filter.
        self._backend.upload(state, cloud.states[stage.state])
        if marks is None or not part.size:
            return [(np.empty((0, 3)), np.empty(0))] * len(marks or ())
        ends, poses = self._read(cloud.ends, part.size) + offset, cloud.host_poses(stage.source, part.size)
        begins, finals = (np.searchsorted(ends, side, side="right") for side in np.array(marks).T)
        return [(poses[a : b + 1], ends[a : b + 1]) for a, b in zip(begins, finals, strict=True)]

    def _choose_rung(self, totals: np.ndarray, left: float) -> None:
        """Set the share for which the kernel, which counts the shard's particles, chooses the whole filter's rung."""
        if not left > 0.0:
            return
        count, least = float(self._part.size), self._settings[SHARE] * self._part.whole
        wanted, share = rung_of(totals, self._settings, least), least / count
        for _ in range(_UNITS):
            found = rung_of(totals, self._settings, share * count)
            if found == wanted:
                break
            # The rounded quotient may be a unit in the last place off.
            share = float(np.nextafter(share, math.inf if found < wanted else 0.0))
        else:
            raise RuntimeError(f"weights: must have a share for rung {wanted} of {count:g} particles, got none")
        self._upload_settings(self._part, share)

    def shift_ends(self, offset: float) -> Step:
        """Add the weights of all preceding shards to the cumulative weights on the device, and wait."""
        cloud, part = self._cloud, self._part
        if part.size and offset:
            if self._ones is None:
                self._ones = self._backend.upload(np.ones(cloud.capacity)), self._backend.empty(SETTINGS, _DOUBLE)
            (ones, factor), settings = self._ones, np.zeros(SETTINGS)
            settings[TEMPERATURE + 1] = offset
            self._backend.upload(settings, factor)
            # The kernel adds a multiple of one array to a second one, exactly for these integers.
            self._backend.run((
                launch("add_scores", flags_if(FLOAT64=True), (cloud.blocks,), log_p=ones,
                       settings=factor, score=cloud.ends, largest=cloud.sums.largest, sensor=1,
                       particles=part.size, block=part.block),
            ))  # fmt: skip
        yield
        self._backend.synchronize()

    def take(self, source: int, shards: Sequence[Shard]) -> Step:
        """Copy the particles of all shards from device to device."""
        self._pool.reserve(self._part.whole, self._part.whole)
        for one in shards:
            self._pool.take(one._cloud.poses[source], one._cloud.ends, one._part.first, one._part.size)
        yield

    def reaches(self, other: Shard) -> bool:
        """Tell whether the device can copy from the device of another shard."""
        return self._gpu and self._backend.copies_from(other._backend)

    def draw(self, stage: Stage, drawn: Part, pieces: Sequence[Piece] | bool) -> Step:
        """Draw the particles of the next stage or step.

        Args:
            stage: The stage.
            drawn: Particles to draw.
            pieces: Poses and cumulative weights of all shards in order; True if the device has already taken them,
                False to draw from the shard's particles alone.
        """
        cloud, found = self._cloud, self._pool
        of: tuple[Any, Any, int] = cloud.poses[stage.source], cloud.ends, self._part.size
        if pieces is not False:
            if pieces is not True:
                found.upload(pieces, self._part.whole)
            of = found.poses, found.ends, found.count
        if drawn.size:
            self._upload_settings(drawn)
            counting: Program = ()
            copies = None
            if self._residual and pieces is not False:
                counting, copies = found.copies(cloud.states[stage.state], drawn.whole, stage.number)
            self._backend.run(counting + cloud.drawing(of, stage, drawn.size, copies))
        self._set_part(drawn)
        yield

    # ---- results

    def poses(self, index: int, count: int) -> Step:
        """Return poses of a buffer."""
        yield
        return self._cloud.host_poses(index, count)

    def weights(self, index: int, count: int) -> Step:
        """Return weights of a buffer."""
        yield
        return self._read(self._cloud.weights[index], count)

    def sum_poses(self, buffers: tuple[int, int], count: int, block: int, reference: np.ndarray) -> Step:
        """Return (blocks, 13) sums of weighted poses relative to a reference pose, both from their buffers."""
        cloud, blocks = self._cloud, -(-count // block)
        if not count:
            yield
            return np.empty((0, ESTIMATE_SUMS))
        estimate = np.zeros(ESTIMATE)
        estimate[:3] = reference
        self._backend.upload(estimate, cloud.estimated)
        self._backend.run(
            cloud.sums.launch("sum_poses", blocks, poses=cloud.poses[buffers[0]], weight=cloud.weights[buffers[1]],
                              estimate=cloud.estimated, sums=cloud.sums.rows, particles=count, block=block,
                              lanes=ESTIMATE_LANES, second_pass=1),
        )  # fmt: skip
        yield
        return self._read(cloud.sums.rows, blocks * ESTIMATE_SUMS).reshape(blocks, ESTIMATE_SUMS)

    # ---- times

    def time_scoring(self) -> Step:
        """Wait for the log-likelihoods of each stage from now on."""
        self._timed = True
        yield

    def scoring_seconds(self) -> Step:
        """Return the seconds of all log-likelihoods."""
        yield
        return sum(sensor.seconds for sensor in self._sensors)

    def _read(self, buffer: Any, count: int) -> np.ndarray:
        return self._backend.download(buffer, np.empty(count))
