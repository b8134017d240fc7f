"""The particle cloud of a filter on one device: its steps, and the numbers that it copies to the host.

A correction runs stages until the temperature is used up. On a GPU motion, scores and weights of a stage are one
recorded program.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable
from typing import Any

import numpy as np

from gpusense.backends.base import Backend, Buffer
from gpusense.backends.programs import ProgramCache, RecordedProgram, RepeatedPrograms
from gpusense.interface.constants import ESTIMATE, LEFT, MOMENTS, SLOW_RATE, STAGE, STATE, WIDE_HEADINGS
from gpusense.interface.launches import Program
from gpusense.localization.filter_cloud import Contents, Summary, deeper, is_starved, meaningful, summary_of
from gpusense.localization.particles import Particles, Stage
from gpusense.localization.sums import weight_block

_DOUBLE = np.dtype(np.float64)
_MOST_RECORDED = 32


class Cloud(Particles):
    """Particles whose steps are recorded.

    Args:
        backend: The device.
        capacity: Most particles.
        sensors: Most sensors of a correction.
        precision: Precision of the log-likelihoods.
        residual: Whether to draw by residual resampling.
    """

    def __init__(
        self, backend: Backend, capacity: int, sensors: int, precision: np.dtype, *, residual: bool = False
    ) -> None:
        super().__init__(backend, capacity, sensors, precision, residual=residual)
        self._recordings = ProgramCache[RecordedProgram](_MOST_RECORDED)
        self._estimates, self._stages = RepeatedPrograms(backend, 8), RepeatedPrograms(backend, 24)
        self._uploads: list[np.ndarray] = []

    def place(self, poses: np.ndarray, weights: np.ndarray | None = None) -> None:
        """Replace all particles."""
        count = len(poses)
        w = np.ones(count) if weights is None else weights * (count / weights.sum())
        places = self.places.placed(self.kept)
        self._fill((self.poses[places.shown], poses), (self.weights[places.weight], w),
                   (self.states[places.state], np.zeros(STATE)))  # fmt: skip
        self.set_particles(places, count, weight_block(self.backend, count))

    def _fill(self, *arrays: tuple[Buffer, np.ndarray]) -> None:
        """Copy arrays to buffers that earlier steps may still use."""
        self.backend.synchronize()
        for buffer, array in arrays:
            self.backend.upload(np.ascontiguousarray(array, np.float64), buffer)

    def set_pool(self, poses: np.ndarray) -> None:
        """Upload the poses from which recovery injects particles."""
        self._recordings.clear()
        self._stages.clear()
        self.pool, self.pool_size = self.backend.upload(np.ascontiguousarray(poses, np.float64)), len(poses)

    def upload_settings(self, settings: np.ndarray) -> None:
        """Copy the settings of a step to the device."""
        self._uploads.append(settings)
        self.backend.upload(settings, self.settings, wait=False)
        if len(self._uploads) > 64:
            self.wait()

    def wait(self) -> None:
        """Wait until the device is idle."""
        self.backend.synchronize()
        self._uploads.clear()

    # ---- steps

    def move(self, settings: np.ndarray, kind: int) -> None:
        """Move the particles now."""
        places = self.places.moved(self.kept)
        self.upload_settings(settings)
        self._move(self.places.next, places.next, kind)
        self.places = places

    def _move(self, origin: int, target: int, kind: int) -> None:
        self._stages.run((origin, target, kind, self.count, "move"), lambda: self.motion(origin, target, kind))

    def run_stages(
        self, settings: np.ndarray, stages: list[Stage], drawn: int, sensors: int, score: Callable[[Stage], None]
    ) -> None:
        """Run a correction: stages until the temperature is used up.

        Args:
            settings: Settings of the step.
            stages: The stages.
            drawn: Particles of the next step.
            sensors: Number of sensors that are used, the first ones of ``log_p``.
            score: Runs the launches of a stage: its motion if it is the first one, log-likelihoods, and weighing.
        """
        self.use(sensors)
        self.upload_settings(settings)
        if settings[SLOW_RATE] > 0:
            # Averages of the likelihood persist.
            self._copy_state(self.places.state, stages[0].state)
        for stage in stages:
            last, deep = stage.most == 1, settings
            score(stage)
            if not last:
                numbers, deep = self._deepen(stage, settings)
                last = numbers[stage.number * STAGE + LEFT] == 0.0
                self._draw(stage, drawn if last else self.count)
            if deep is not settings:
                self.upload_settings(settings)
            if last:
                break
        self.set_particles(stage.places, drawn, weight_block(self.backend, drawn))

    def _deepen(self, stage: Stage, settings: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Weigh a stage again on lower rungs while too few particles have weight; return state and settings."""
        numbers = self._read(self.states[stage.state], STATE)
        while is_starved(numbers, settings, stage.number, self.count):
            settings = deeper(settings)
            self.upload_settings(settings)
            self.backend.run(self.weighing(stage))
            numbers = self._read(self.states[stage.state], STATE)
        return numbers, settings

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
        self._stages.run((stage.key, self.count, self._sensors), lambda: self.weighing(stage))

    def _draw(self, stage: Stage, drawn: int) -> None:
        """Draw into the other buffer."""
        self._stages.run((stage.key, drawn, self.count, "draw"), lambda: self.draw(stage, drawn))

    def replay(self, stage: Stage, key: Hashable, scoring: Callable[[int], tuple[Program, object]]) -> None:
        """Run a stage as one recorded program.

        Args:
            stage: The stage.
            key: Everything on which the sensors' programs depend.
            scoring: Returns the program that scores the poses of a buffer, and the owners of its memory.
        """
        whole = (key, stage, self.count)
        recorded = self._recordings.get(whole)
        if recorded is None:
            move = () if stage.kind is None else self.motion(stage.origin, stage.source, stage.kind)
            program, owners = scoring(stage.source)
            program = move + program + self.weighing(stage)
            recorded = self._recordings.keep(whole, RecordedProgram(self.backend, program, owners))
        recorded.start()

    def explain(self) -> str:
        """Describe how the last recorded step is started."""
        recorded = self._recordings.items()
        return recorded[-1][1].recording.explain() if recorded else "launches one by one"

    # ---- copies to the host

    def summary(self) -> Summary:
        """Return the state after the last correction."""
        return summary_of(self._read(self.states[self.places.state], STATE))

    def shares(self, count: int) -> Any:
        """Return the weights of the shown particles with sum 1: on a GPU an array of the device's library."""
        if self.backend.info.kind != "gpu":
            weights = self.host_weights(count)
            return weights / weights.sum()
        return self.backend.lend(self.device_shares(count), (count,), _DOUBLE)

    def device_shares(self, count: int) -> Buffer:
        """Return a new buffer with the weights of the shown particles, with sum 1."""
        out, weight = self.backend.blank(count, _DOUBLE), self.weights[self.places.weight]
        program = self.sums.estimate(self.poses[self.places.shown], weight, self.estimated, count)
        program += self.sums.launch("normalize_weights", count, weight=weight, estimate=self.estimated, share=out,
                                    particles=count)  # fmt: skip
        self.backend.run(program)
        return out

    def moments(self, count: int) -> Any:
        """Return mean and covariance of the shown particles: on a GPU an array of the device's library."""
        if self.backend.info.kind != "gpu":
            return self.estimate(count)[:MOMENTS]
        out, poses, weight = self.backend.blank(ESTIMATE, _DOUBLE), self.poses[self.places.shown], self.places.weight
        for second_pass in (0, 1):
            # The second pass is correct for any headings.
            self.backend.run(self.sums.estimate(poses, self.weights[weight], out, count, second_pass))
        return self._lent(out, (MOMENTS,))

    def particles(self, count: int) -> Any:
        """Return the shown poses: on a GPU an array of the device's library."""
        if self.backend.info.kind != "gpu":
            return self.host_poses(self.places.shown, count)
        return self._lent(self.poses[self.places.shown], (count, 3))

    def estimate(self, count: int) -> np.ndarray:
        """Return the kernels' estimate of the shown particles: mean, covariance, sum of weights."""
        numbers = self._estimate(count, 0)
        return self._estimate(count, 1) if numbers[WIDE_HEADINGS] else numbers

    def _estimate(self, count: int, second_pass: int) -> np.ndarray:
        """Run a pass of the estimate, and return its buffer."""
        shown, weight = self.places.shown, self.places.weight
        # Clouds that change their size rarely ask twice for the same size.
        self._estimates.run(
            (shown, weight, count, second_pass),
            lambda: self.sums.estimate(self.poses[shown], self.weights[weight], self.estimated, count, second_pass),
        )
        return self._read(self.estimated, ESTIMATE)

    def host_poses(self, index: int, count: int) -> np.ndarray:
        """Return a copy of the poses of a buffer."""
        return self._read(self.poses[index], 3 * count).reshape(count, 3)

    def host_weights(self, count: int) -> np.ndarray:
        """Return a copy of the weights of the shown particles, before they are normalised."""
        return self._read(self.weights[self.places.weight], count)

    def contents(self, count: int) -> Contents:
        """Return a copy of all particles, of which ``count`` are shown."""
        places, weighed = self.places, self.places.shown != self.places.next
        return Contents(
            self.host_poses(places.shown, count), self.host_weights(count),
            self.host_poses(places.next, self.count) if weighed else None,
            self._read(self.weights[places.before], self.count) if weighed else None,
            meaningful(self._read(self.states[places.state], STATE), self.pool_size > 0),
            self._read(self.pool, 3 * self.pool_size).reshape(-1, 3) if self.pool_size else None,
        )  # fmt: skip

    def restore(self, contents: Contents) -> None:
        """Replace all particles by those of ``contents``."""
        if contents.pool is not None:
            self.set_pool(contents.pool)
        places, arrays = contents.places_and_arrays(self.kept)
        self._fill(*((getattr(self, name)[index], array) for name, index, array in arrays),
                   (self.states[places.state], contents.state))  # fmt: skip
        self.set_particles(places, contents.next_count, weight_block(self.backend, contents.next_count))

    def _read(self, buffer: Buffer, count: int) -> np.ndarray:
        return self.backend.download(buffer, np.empty(count))

    def _lent(self, buffer: Buffer, shape: tuple[int, ...]) -> Any:
        """Return the head of a buffer as an array of the device's library."""
        return self.backend.lend(self.backend.part(buffer, 0, math.prod(shape), _DOUBLE), shape, _DOUBLE)
