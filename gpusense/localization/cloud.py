"""Run the steps of a filter's particle cloud on a device, and copy its results to the host.

A correction runs stages until the temperature is used up. On a GPU motion, scores and weights of a stage are one
recorded program.
"""

from __future__ import annotations

import math
import weakref
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import numpy as np

from gpusense.backends.base import Backend, Buffer
from gpusense.backends.workspace import ProgramCache, RecordedProgram, RepeatedPrograms
from gpusense.interface.constants import ESTIMATE, FAR_SHARE, LEFT, MOMENTS, SLOW_RATE, STAGE, STATE, WIDE_HEADINGS
from gpusense.interface.launches import Program
from gpusense.localization.beam_consistency import MapJudge
from gpusense.localization.cloud_state import Contents, Snapshot, Summary, deeper, is_starved, meaningful, summary_of
from gpusense.localization.particles import BufferSlots, Particles, Stage

_DOUBLE = np.dtype(np.float64)
_MOST_RECORDED, _MOST_STAGES = 64, 48
# Consecutive corrections with a read estimate after which corrections compute the estimate.
_ASKED = 3


class Cloud(Particles):
    """Particles with recorded steps."""

    def __init__(
        self, backend: Backend, capacity: int, readings: Sequence[int], precision: np.dtype, *, residual: bool = False
    ) -> None:
        super().__init__(backend, capacity, readings, precision, residual=residual)
        self._recordings = ProgramCache[RecordedProgram](_MOST_RECORDED)
        self._estimates, self._stages = RepeatedPrograms(backend, 8), RepeatedPrograms(backend, _MOST_STAGES)
        self._uploads: list[np.ndarray] = []
        # Results on the host while they are valid; buffers and number of particles behind the estimate on the device,
        # and behind the final estimate on the host.
        self._results: np.ndarray | None = None
        self._summary: tuple[np.ndarray, int, Summary] | None = None
        self._estimated_of: Hashable = None
        self._refined_of: Hashable = None
        self._known: tuple[Hashable, np.ndarray] | None = None
        self._snapshots: list[weakref.ref[Snapshot]] = []
        # Consecutive corrections with a read estimate; whether the last one's was read; whether the stages of the
        # present one compute the estimate; the same for the second pass, of one correction.
        self._asked, self._was_asked, self._estimates_too = 0, False, False
        self._was_refined, self._refines_too = False, False
        # Function that prepares judges of scans; judges of the last correction until they receive the result.
        self._prepared: Callable[[], list[MapJudge]] | None = None
        self._judges: Sequence[MapJudge] = ()
        # Inputs of a recorded correction that are not yet on the device, and readings of other arrays of the device;
        # work of the host while the device runs a stage.
        self._given: np.ndarray | None = None
        self._adopted: Sequence[tuple[Buffer, Buffer, int]] = ()
        self._meanwhile: Callable[[], None] | None = None

    def place(self, poses: np.ndarray) -> None:
        """Replace all particles by (N, 3) poses of equal weight, and reset the state of corrections."""
        count, places = len(poses), self.places.placed(self.kept)
        self._fill((self.poses[places.shown], poses), (self.weights[places.weight], np.ones(count)),
                   (self.states[places.state], np.zeros(STATE)))  # fmt: skip
        self.set_particles(places, count)

    def _fill(self, *arrays: tuple[Buffer, np.ndarray]) -> None:
        """Copy arrays to buffers that earlier steps may still use."""
        self._begin_change()
        self.backend.synchronize()
        for buffer, array in arrays:
            self.backend.upload(np.ascontiguousarray(array, np.float64), buffer)

    def set_pool(self, poses: np.ndarray) -> None:
        """Upload poses for recovery to inject."""
        self._recordings.clear()
        self._stages.clear()
        self.pool, self.pool_size = self.backend.upload(np.ascontiguousarray(poses, np.float64)), len(poses)

    def upload_settings(self, settings: np.ndarray) -> None:
        """Copy the settings of a step to the device."""
        self.backend.upload(self._held(settings), self.settings, wait=False)

    def _held(self, array: np.ndarray) -> np.ndarray:
        """Return an array, kept alive until the device has read it."""
        if len(self._uploads) > 64:
            self.wait()
        self._uploads.append(array)
        return array

    def wait(self) -> None:
        """Wait until the device is idle."""
        self.backend.synchronize()
        self._uploads.clear()

    def _begin_change(self) -> None:
        """Invalidate the results on the host, and save the particles that the change may overwrite."""
        self._results = self._known = self._estimated_of = self._refined_of = None
        self._judges, self._prepared, self._given, self._adopted = (), None, None, ()
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

    def run_stages(
        self, settings: np.ndarray, stages: list[Stage], drawn: int, sensors: int, score: Callable[[Stage], None],
        judges: Callable[[], list[MapJudge]] | None = None,
        meanwhile: Callable[[], None] | None = None, given: Callable[[], None] | None = None,
    ) -> None:  # fmt: skip
        """Run a correction: stages until the temperature is used up.

        Args:
            settings: Settings of the step.
            stages: The stages.
            drawn: Particles of the next step.
            sensors: Number of sensors, the first ones of ``log_p``.
            score: Runs a stage: motion if it is the first one, log-likelihoods, and weighing.
            judges: Prepares and returns the judges of scans at the estimated pose; called if the pose is estimated.
            meanwhile: Called while the device works on the first stage.
            given: Sets the inputs of a recorded correction, which its first stage copies to the device.
        """
        self._sensors = sensors
        self._begin_change()
        self._prepared, self._meanwhile = judges, meanwhile
        self._asked, self._was_asked = self._asked + 1 if self._was_asked else 0, False
        self._estimates_too = self._asked >= _ASKED
        self._refines_too, self._was_refined = self._estimates_too and self._was_refined, False
        if given is None:
            self.upload_settings(settings)
        else:
            given()
        if settings[SLOW_RATE] > 0:
            # Keep the averages of the likelihood.
            self._copy_state(self.places.state, stages[0].state)
        for stage in stages:
            last, deep = stage.most == 1, settings
            self._results = None
            score(stage)
            self._use_wait()
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
        self._estimated_of = (places, self.count) if self._estimates_too else None
        self._refined_of = (places, self.count) if self._refines_too else None
        self.set_particles(places, drawn)

    def _deepen(self, stage: Stage, settings: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Repeat a stage's weighing on lower rungs while too few particles have weight; return state and settings."""
        numbers = self._state_of(stage.state)
        while is_starved(numbers, settings, stage.number, self.count):
            settings = deeper(settings)
            self.upload_settings(settings)
            self._results = None
            self.backend.run(self._weighing(stage) + self._judging())
            numbers = self._state_of(stage.state)
        return numbers, settings

    def _weighing(self, stage: Stage) -> Program:
        """Return the launches of a stage after its scores, including the estimate if it is expected."""
        program = self.weighing(stage)
        if self._estimates_too:
            program += self._estimating(stage.places, self.count)
        if self._refines_too:
            program += self._estimating(stage.places, self.count, self.refined)
        return program

    def _judging(self) -> Program:
        """Return the launches for judging scans at the estimate."""
        triples = zip(self._judges, self.scans, self.judged, strict=False)
        return tuple(one for judge, *buffers in triples for one in judge.launches(self.estimated, *buffers))

    def _prepare_judges(self) -> Hashable:
        """Prepare the judges of a correction that estimates the pose; return the key of their launches."""
        if not self._estimates_too:
            return ()
        if self._prepared is not None:
            self._judges, self._prepared = self._prepared(), None
        return tuple([judge.version for judge in self._judges])

    def _use_wait(self) -> None:
        """Do the host's work of a correction while the device runs its first stage."""
        meanwhile, self._meanwhile = self._meanwhile, None
        if meanwhile is not None:
            meanwhile()

    def _estimating(self, places: BufferSlots, count: int, refined: Buffer | None = None) -> Program:
        """Return the launches of the estimate, or of its second pass."""
        poses, weights = self.poses[places.shown], self.weights[places.weight]
        return self.sums.estimate(poses, weights, self.estimated, count, refined)

    def _copy_state(self, source: int, target: int) -> None:
        if self.backend.info.kind == "gpu":
            self.backend.copy(self.states[source], self.states[target], STATE * _DOUBLE.itemsize)
        else:
            self.backend.upload(self._read(self.states[source], STATE), self.states[target])

    def begin(self, stage: Stage) -> None:
        """Start the motion of a correction."""
        if stage.kind is not None:
            self._move(stage.origin, stage.source, stage.kind)

    def weigh(self, stage: Stage) -> None:
        """Run the launches of a stage after its scores."""
        key = (stage.key, self.count, self._sensors, self._estimates_too, self._refines_too)
        self._stages.run(key, lambda: self._weighing(stage))
        # Prepare scans while the device works.
        versions = self._prepare_judges()
        if versions:
            self._stages.run((versions, "judge"), self._judging)

    def _draw(self, stage: Stage, drawn: int) -> None:
        """Draw into the other buffer."""
        self._stages.run((stage.key, drawn, self.count, "draw"), lambda: self.draw(stage, drawn))

    def replay(self, stage: Stage, key: Hashable, scoring: Callable[[int], tuple[Program, object]]) -> None:
        """Run a stage as one recorded program; ``scoring`` makes the sensors' part for a buffer of poses."""
        whole = (key, stage, self.count, self._estimates_too, self._refines_too, self._prepare_judges())
        recorded = self._recordings.get(whole)
        if recorded is None:
            move = () if stage.kind is None else self.motion(stage.origin, stage.source, stage.kind)
            program, owners = scoring(stage.source)
            program = move + program + self._weighing(stage) + self._judging()
            recorded = self._recordings.keep(whole, RecordedProgram(self.backend, program, owners))
        self._start(recorded, read=stage.most > 1 or self._estimates_too)

    def _start(self, recorded: RecordedProgram, *, read: bool) -> None:
        """Start a stage, and copy a correction's inputs and results with it: one graph of a CUDA device."""
        backend, given, self._given = self.backend, self._given, None
        if given is not None:
            self._held(given)
        backend.begin_batch()
        try:
            if given is not None:
                backend.upload(given, self.inputs.buffer, wait=False)
                for source, target, size in self._adopted:
                    backend.copy(source, target, size)
            recorded({})
            if read and backend.in_batch:
                results = backend.download(self.results.buffer, np.empty(self.results.size), wait=False)
                backend.submit()
                self._use_wait()
                backend.synchronize()
                self._results = results
        finally:
            backend.end_batch()

    def explain(self) -> str:
        """Describe how the last recorded step starts."""
        recorded = self._recordings.items()
        return recorded[-1][1].recording.explain() if recorded else "launches one by one"

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
        return self._lent(out, (MOMENTS,))

    def particles(self, count: int) -> Any:
        """Return the shown poses: on a GPU an array of the device's library."""
        if self.backend.info.kind != "gpu":
            return self.host_poses(self.places.shown, count)
        return self._lent(self.poses[self.places.shown], (count, 3))

    def estimate(self, count: int) -> np.ndarray:
        """Return mean, covariance and sum of weights of the shown particles from the kernels; not to be changed."""
        self._was_asked, key = True, (self.places, count)
        if self._known is None or self._known[0] != key:
            numbers = self._estimate(count)
            if numbers[WIDE_HEADINGS]:
                numbers = np.concatenate([numbers[:3], self._refined(count)[3:MOMENTS], numbers[MOMENTS:]])
            self._known = key, numbers
        return self._known[1]

    def far_share(self, count: int) -> float:
        """Return the share of the shown particles beyond 1 m or 0.5 rad of the mean."""
        self.estimate(count)
        return float(self._refined(count)[FAR_SHARE])

    def snapshot(self, count: int) -> Snapshot:
        """Return the function that copies the shown particles of now to the host, at any later time."""
        made = Snapshot(self, count)
        self._snapshots.append(weakref.ref(made))
        return made

    def _estimate(self, count: int) -> np.ndarray:
        """Return the estimate; compute it unless the last correction did."""
        places = self.places
        if self._estimated_of != (places, count):
            self._results, self._judges = None, ()
            # Clouds of varying size rarely repeat a size.
            self._estimates.run((places.shown, places.weight, count), lambda: self._estimating(places, count))
            self._estimated_of = places, count
        numbers, (first, _, *spans) = self._read_results(), self.results.spans[2:]
        estimate = numbers[first]
        for judge, span in zip(self._judges, spans, strict=False):
            judge.receive(estimate, numbers[span])
        self._judges = ()
        return estimate

    def _refined(self, count: int) -> np.ndarray:
        """Return the second pass of the present estimate; compute it unless the last correction did."""
        places, self._was_refined = self.places, True
        if self._refined_of != (places, count):
            self._results = None
            self._estimates.run(
                (places.shown, places.weight, count, "refined"), lambda: self._estimating(places, count, self.refined)
            )
            self._refined_of = places, count
        return self._read_results()[self.results.spans[3]]

    def _state_of(self, index: int) -> np.ndarray:
        """Return a state."""
        return self._read_results()[self.results.spans[index]]

    def _read_results(self) -> np.ndarray:
        """Return states and estimate, copied once after each change."""
        if self._results is None:
            self._results = self._read(self.results.buffer, self.results.size)
        return self._results

    def host_poses(self, index: int, count: int) -> np.ndarray:
        """Return a copy of the poses of a buffer."""
        return self._read(self.poses[index], 3 * count).reshape(count, 3)

    def host_weights(self, count: int, index: int | None = None) -> np.ndarray:
        """Return a copy of the unnormalised weights of a buffer, by default of the shown particles."""
        return self._read(self.weights[self.places.weight if index is None else index], count)

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
        places, arrays = contents.places_and_arrays(self.kept)
        self._fill(*((getattr(self, name)[index], array) for name, index, array in arrays),
                   (self.states[places.state], contents.state))  # fmt: skip
        self.set_particles(places, contents.next_count)

    def _read(self, buffer: Buffer, count: int) -> np.ndarray:
        return self.backend.download(buffer, np.empty(count))

    def _lent(self, buffer: Buffer, shape: tuple[int, ...]) -> Any:
        """Return the head of a buffer as an array of the device's library."""
        return self.backend.wrap_external(self.backend.part(buffer, 0, math.prod(shape), _DOUBLE), shape, _DOUBLE)
