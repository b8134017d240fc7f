"""Run the steps of a filter's particles on the device of its sensors, and copy results to the host.

A correction runs stages until the temperature is used up. On a GPU motion, scores, weights, the estimate and the beams
to judge are one recorded program of a stage: one copy writes all of its inputs, and one reads all of its results. In
CUDA the copies are part of its graph. The second pass of the estimate is part of it if the particles were almost wide,
and a judgement if the pose will probably be judged. While the device works, the host learns from the last lesson
(:mod:`gpusense.localization.lessons`).
"""

from __future__ import annotations

import functools
import weakref
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import numpy as np

from gpusense.backends.base import Buffer
from gpusense.backends.workspace import ProgramCache, RecordedProgram, RepeatedPrograms
from gpusense.interface.constants import ESTIMATE, FAR_SHARE, LEFT, MOMENTS, SLOW_RATE, STAGE, STATE, WIDE_HEADINGS
from gpusense.interface.launches import Program
from gpusense.localization.beam_consistency import JUDGED, MapJudge
from gpusense.localization.cloud_state import Contents, Snapshot, Summary, deeper, is_starved, meaningful, summary_of
from gpusense.localization.particles import BufferSlots, Particles, Stage
from gpusense.localization.sensors import Sensor, SensorReadings

_DOUBLE = np.dtype(np.float64)
# Passes of the estimate before any has run.
_NO_PASSES: dict[bool, Hashable] = {False: None, True: None}
# Most recorded steps, other programs, and programs of sensors.
_MOST_RECORDED, _MOST_STAGES, _MOST_PROGRAMS = 64, 48, 8


class Cloud(Particles):
    """Particles of a filter on the device of its sensors.

    Steps never write buffers named in ``kept``, and finally name the new buffers in ``places``. Restoring the
    attributes in ``MEMORY`` therefore undoes an interrupted call of a filter.
    """

    def __init__(self, sensors: Sequence[Sensor], capacity: int, *, residual: bool = False) -> None:
        readings = [sensor.readings for sensor in sensors]
        super().__init__(sensors[0].backend, capacity, readings, sensors[0].precision, residual=residual)
        self._scored = sensors
        self._recordings = ProgramCache[RecordedProgram](_MOST_RECORDED)
        self._programs = ProgramCache[tuple[Program, object]](_MOST_PROGRAMS)
        self._estimates, self._stages = RepeatedPrograms(self.backend, 8), RepeatedPrograms(self.backend, _MOST_STAGES)
        # Results on the host while they are valid; buffers and number of particles behind both passes of the estimate
        # on the device, and behind the final estimate on the host.
        self._results: np.ndarray | None = None
        self._summary: tuple[np.ndarray, int, Summary] | None = None
        self._passes = dict[bool, Hashable](_NO_PASSES)
        self._known: tuple[Hashable, np.ndarray] | None = None
        self._snapshots: list[weakref.ref[Snapshot]] = []
        # Whether stages of the present correction compute the second pass of the estimate.
        self._refines_too = False
        # Number of sensors of the present correction; judges of its scans.
        self._used = 0
        self._judges: list[MapJudge] = []
        # Inputs of a recorded correction, and readings of other arrays of the device; whether results are on their way.
        self._exchange = self.backend.exchange(
            self.inputs.buffer, self.inputs.size, self.results.buffer, self.results.size, _DOUBLE
        )
        self._given: np.ndarray | None = None
        self._adopted: Sequence[tuple[Buffer, Buffer, int]] = ()
        self._is_running = False

    def place(self, poses: np.ndarray) -> None:
        """Replace all particles by (N, 3) poses of equal weight, and reset the state of corrections."""
        count, places = len(poses), self.places.placed(self.kept)
        self._begin_change()
        self.fill((self.poses[places.shown], poses), (self.weights[places.weight], np.ones(count)),
                   (self.states[places.state], np.zeros(STATE)))  # fmt: skip
        self.set_particles(places, count)

    def set_pool(self, poses: np.ndarray) -> None:
        """Upload poses for recovery to inject."""
        self._recordings.clear()
        self._stages.clear()
        self.pool, self.pool_size = self.backend.upload(np.ascontiguousarray(poses, np.float64)), len(poses)

    def _begin_change(self) -> None:
        """Invalidate the results on the host, and save the particles that the change may overwrite."""
        self._change_results()
        self._known, self._passes = None, _NO_PASSES
        self._judges, self._given, self._adopted = [], None, ()
        for one in self._snapshots:
            snapshot = one()
            if snapshot is not None and snapshot.places.free() != self.kept.free():
                snapshot()
        self._snapshots = [one for one in self._snapshots if (kept := one()) is not None and kept.is_on_device]

    # ---- steps

    def move(self, settings: np.ndarray, kind: int) -> None:
        """Move the particles now."""
        self._begin_change()
        places = self.places.moved(self.kept)
        self.upload_settings(settings)
        self._move(self.places.next, places.next, kind)
        self.places = places

    def _move(self, origin: int, target: int, kind: int) -> None:
        self._stages.run((origin, target, kind, self.count, "move"), lambda: self.motion(origin, target, kind))

    def correct(
        self, settings: np.ndarray, kind: int, stages: int, drawn: int, readings: list[SensorReadings],
        judged: Sequence[SensorReadings] = (), meanwhile: Callable[[], None] | None = None, *, refines: bool = False,
    ) -> None:  # fmt: skip
        """Run a correction by readings after a kind of motion: stages until the temperature is used up.

        It draws a number of particles, estimates the pose (``refines``: by both passes), judges scans there, and calls
        ``meanwhile`` while the device works on the first stage.
        """
        indices = [index for index, _ in readings]
        self._begin_change()
        self._used = len(indices)
        self._refines_too = refines
        recorded = self.backend.info.kind == "gpu"
        for index, reading in readings:
            recorded = recorded and self._scored[index].records(reading)
        if recorded:
            self._give(settings, readings)
        else:
            self.upload_settings(settings)
        planned = self.places.stages(self.kept, stages, drawn, kind, same=drawn == self.count)
        if settings[SLOW_RATE] > 0:
            # Keep the averages of the likelihood.
            self.copy_state(self.places.state, planned[0].state)
        for stage in planned:
            last, deep = stage.most == 1, settings
            self._change_results()
            if recorded:
                self._replay(indices, stage, judged)
            else:
                self._call(readings, stage, judged)
            if meanwhile is not None:
                meanwhile()
            judged, meanwhile = (), None
            if not last:
                numbers, deep = self._deepen(stage, settings)
                last = numbers[stage.number * STAGE + LEFT] == 0.0
                if not stage.drawn:
                    self._draw(stage, drawn if last else self.count)
            if deep is not settings:
                self.upload_settings(settings)
            if last:
                break
        places = stage.places
        self._passes = {False: (places, self.count), True: (places, self.count) if self._refines_too else None}
        self.set_particles(places, drawn)

    def _give(self, settings: np.ndarray, readings: list[SensorReadings]) -> None:
        """Set the inputs of a recorded correction."""
        self._given, adopted = self._exchange.begin(), []
        self._given[self.inputs.spans[0]] = settings
        for index, reading in readings:
            target = self.readings[index]
            source = self._scored[index].place(reading, self._given[self.inputs.spans[1 + index]])
            if source is not None:
                adopted.append((source, target, self._scored[index].readings * _DOUBLE.itemsize))
        self._adopted = adopted

    def _call(self, readings: Sequence[SensorReadings], stage: Stage, judged: Sequence[SensorReadings]) -> None:
        """Start the log-likelihoods of a stage call by call, and weigh."""
        poses = self.poses_of(stage.source)
        before = None if stage.kind is None else functools.partial(self._move, stage.origin, stage.source, stage.kind)
        for place, (index, reading) in enumerate(readings):
            self._scored[index].score(poses, reading, self.log_p_of(place), before=before)
            before = None
        key = (stage.key, self.count, len(readings), self._refines_too)
        self._stages.run(key, lambda: self._weighing(stage))
        # Prepare scans while the device works.
        versions = self._prepare_judges(judged)
        if versions:
            self._stages.run((versions, "judge"), self._judging)

    def _replay(self, indices: list[int], stage: Stage, judged: Sequence[SensorReadings]) -> None:
        """Run a stage of a correction by sensors ``indices`` as one recorded program."""
        sensors = tuple([(index, self._scored[index].model.table_version) for index in indices])
        key = (sensors, stage, self.count, self._refines_too, self._prepare_judges(judged))
        recorded = self._recordings.get(key)
        if recorded is None:
            move = () if stage.kind is None else self.motion(stage.origin, stage.source, stage.kind)
            program, owners = self._program((sensors, self.count, stage.source), indices, stage.source)
            program = move + program + self._weighing(stage) + self._judging()
            recorded = self._recordings.keep(key, RecordedProgram(self.backend, program, owners))
        self.backend.check_process()
        self._exchange.start(recorded.recording, between=self._copy_adopted if self._adopted else None)
        self._is_running = True

    def _copy_adopted(self) -> None:
        """Start copying readings of arrays on the device."""
        for source, target, size in self._adopted:
            self.backend.copy(source, target, size)

    def _program(self, key: Hashable, indices: list[int], source: int) -> tuple[Program, object]:
        """Return the launches that score the poses of a buffer, and the owners of their memory."""
        kept = self._programs.get(key)
        if kept is not None:
            return kept
        program: Program = ()
        owners: list[object] = []
        poses = self.poses_of(source)
        for place, index in enumerate(indices):
            out = self.log_p_of(place)
            launches, owner = self._scored[index].program(poses, self.readings[index], out)
            program += launches
            owners.append((poses, out, owner))
        return self._programs.keep(key, (program, owners))

    def _deepen(self, stage: Stage, settings: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Repeat a stage's weighing on lower rungs while too few particles have weight; return state and settings."""
        place = self.results.spans[stage.state]
        numbers = self._read_results()[place]
        while is_starved(numbers, settings, stage.number, self.count):
            settings = deeper(settings)
            self.upload_settings(settings)
            self._change_results()
            self.backend.run(self._weighing(stage) + self._judging())
            numbers = self._read_results()[place]
        return numbers, settings

    def _weighing(self, stage: Stage) -> Program:
        """Return the launches of a stage after its scores."""
        program = self.weighing(stage, self._used) + self._estimating(stage.places, self.count)
        return program + self._estimating(stage.places, self.count, self.refined) if self._refines_too else program

    def _judging(self) -> Program:
        """Return the launches for judging scans at the estimate."""
        triples = zip(self._judges, self.scans, self.judged, strict=False)
        return tuple(one for judge, *buffers in triples for one in judge.launches(self.estimated, *buffers))

    def _prepare_judges(self, scans: Sequence[SensorReadings]) -> Hashable:
        """Let judges expect the scans of a correction; return the key of their launches.

        The beams are inputs of a recorded correction, or are copied to the device.
        """
        given = self._given
        for index, reading in scans:
            sensor, place = self._scored[index], len(self._judges)
            judge = sensor.judge()
            scan = np.empty(JUDGED) if given is None else given[self.inputs.spans[1 + len(self.readings) + place]]
            if judge.expects(sensor.model.scanner, reading[0], sensor.values_of(reading), scan):
                self._judges.append(judge)
                if given is None:
                    self.backend.refill(self.held(scan), self.scans[place])
        return tuple([judge.version for judge in self._judges])

    def _estimating(self, places: BufferSlots, count: int, refined: Buffer | None = None) -> Program:
        """Return the launches of the estimate, or of its second pass."""
        poses, weights = self.poses[places.shown], self.weights[places.weight]
        return self.sums.estimate(poses, weights, self.estimated, count, refined)

    def _draw(self, stage: Stage, drawn: int) -> None:
        """Draw into the other buffer."""
        self._stages.run((stage.key, drawn, self.count, "draw"), lambda: self.draw(stage, drawn))

    def explain(self) -> str:
        """Describe how the last recorded step starts."""
        recorded = self._recordings.items()
        return self._exchange.explain(recorded[-1][1].recording) if recorded else "launches one by one"

    # ---- copies to the host

    def summary(self) -> Summary:
        """Return the state after the last correction."""
        results, index = self._read_results(), self.places.state
        if self._summary is None or self._summary[0] is not results or self._summary[1] != index:
            self._summary = results, index, summary_of(results[self.results.spans[index]])
        return self._summary[2]

    def shares(self, count: int) -> Any:
        """Return the normalised weights of the shown particles: on a GPU an array of the device's library."""
        if self.backend.info.kind != "gpu":
            weights = self.host_weights(count)
            return weights / weights.sum()
        return self.backend.wrap_external(self.device_shares(count), (count,), _DOUBLE)

    def device_shares(self, count: int) -> Buffer:
        """Return a new buffer with the normalised weights of the shown particles."""
        out, weight = self.backend.empty_external(count, _DOUBLE), self.weights[self.places.weight]
        program = self._estimating(self.places, count)
        program += self.sums.launch("normalize_weights", count, weight=weight, estimate=self.estimated, share=out,
                                    particles=count)  # fmt: skip
        self.backend.run(program)
        return out

    def moments(self, count: int) -> Any:
        """Return mean and covariance of the shown particles: on a GPU an array of the device's library."""
        if self.backend.info.kind != "gpu":
            return self.estimate(count)[:MOMENTS]
        out = self.backend.empty_external(ESTIMATE, _DOUBLE)
        poses, weights = self.poses[self.places.shown], self.weights[self.places.weight]
        for refined in (None, out):
            # The second pass is correct for any headings.
            self.backend.run(self.sums.estimate(poses, weights, out, count, refined))
        return self.lent(out, (MOMENTS,))

    def particles(self, count: int) -> Any:
        """Return the shown poses: on a GPU an array of the device's library."""
        if self.backend.info.kind != "gpu":
            return self.host_poses(self.places.shown, count)
        return self.lent(self.poses[self.places.shown], (count, 3))

    def estimate(self, count: int) -> np.ndarray:
        """Return mean, covariance and sum of weights of the shown particles from the kernels; not to be changed."""
        key = self.places, count
        if self._known is None or self._known[0] != key:
            numbers = self._passed(count)
            if numbers[WIDE_HEADINGS]:
                second = self._passed(count, second=True)
                numbers = np.concatenate([numbers[:3], second[3:MOMENTS], numbers[MOMENTS:]])
            self._known = key, numbers
        return self._known[1]

    def far_share(self, count: int) -> float:
        """Return the share of the shown particles beyond 1 m or 0.5 rad of the mean."""
        self.estimate(count)
        return float(self._passed(count, second=True)[FAR_SHARE])

    def snapshot(self, count: int) -> Snapshot:
        """Return the function that copies the shown particles of now to the host, at any later time."""
        made = Snapshot(self, count)
        self._snapshots.append(weakref.ref(made))
        return made

    def _passed(self, count: int, *, second: bool = False) -> np.ndarray:
        """Return a pass of the present estimate; compute it unless the last correction did."""
        places, refined = self.places, self.refined if second else None
        if self._passes[second] != (places, count):
            self._change_results()
            # Clouds of varying size rarely repeat a size.
            key = places.shown, places.weight, count, second
            self._estimates.run(key, lambda: self._estimating(places, count, refined))
            self._passes = {**self._passes, second: (places, count)}
        return self._read_results()[self.results.spans[3 if second else 2]]

    def _read_results(self) -> np.ndarray:
        """Return states, estimate and judged beams, copied once after each change."""
        if self._results is None:
            if self._is_running:
                self._results, self._is_running = self._exchange.finish(), False
            else:
                self._results = self._read(self.results.buffer, self.results.size)
            estimate, _, *spans = self.results.spans[2:]
            for judge, span in zip(self._judges, spans, strict=False):
                judge.receive(self._results[estimate], self._results[span])
        return self._results

    def _change_results(self) -> None:
        """Drop the results on the host, which launches are about to change."""
        self._results, self._is_running = None, False

    def contents(self, count: int) -> Contents:
        """Return a copy of all particles; ``count`` of them are shown."""
        places, weighed = self.places, self.places.shown != self.places.next
        return Contents(
            self.host_poses(places.shown, count), self.host_weights(count),
            self.host_poses(places.next, self.count) if weighed else None,
            self._read(self.weights[places.before], self.count) if weighed else None,
            meaningful(self._read(self.states[places.state], STATE), self.pool_size > 0),
            self._read(self.pool, 3 * self.pool_size).reshape(-1, 3) if self.pool_size else None,
        )  # fmt: skip

    def restore(self, contents: Contents) -> None:
        """Replace all particles by ``contents``."""
        if contents.pool is not None:
            self.set_pool(contents.pool)
        places, following, before = self.places.placed(self.kept), contents.next_poses, contents.next_weights
        self._begin_change()
        if following is not None and before is not None:
            places = places._replace(next=places.shown + 1, weight=places.before - 1)
            self.fill((self.poses[places.next], following), (self.weights[places.before], before))
        self.fill((self.poses[places.shown], contents.poses), (self.weights[places.weight], contents.weights),
                   (self.states[places.state], contents.state))  # fmt: skip
        self.set_particles(places, len(contents.poses if following is None else following))
