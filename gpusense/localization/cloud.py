"""The cloud of a filter: its particles, the steps that change them, and what of it crosses to the host.

A correction has stages until no temperature is left. On a GPU motion, scores and weights of a stage are one recorded
program.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable
from typing import Any, NamedTuple

import numpy as np

from gpusense.backends.base import Backend, Buffer
from gpusense.backends.recording import Recording, Repeated
from gpusense.interface.constants import (
    DEGENERATE,
    DEPTH,
    ESTIMATE,
    FARTHEST_THETA,
    FARTHEST_X,
    JITTER,
    LEFT,
    LOWEST,
    MOMENTS,
    RUNG,
    SAMPLE_SIZE,
    SETTINGS,
    SHARE,
    STAGE,
    STATE,
    WIDE_HEADINGS,
)
from gpusense.interface.launches import Program
from gpusense.localization.particles import Particles, Stage
from gpusense.localization.sums import weight_block
from gpusense.reference.rungs import left_of

_DOUBLE = np.dtype(np.float64)
_MOST_RECORDED = 32
# Lowest depth of a ladder: distances of a million deviations differ by 2^-39 on its last rung.
_DEEPEST = LOWEST**5
# Jitter of a stage on such a ladder: the peak lies beyond the particles, and they must not shrink before they reach it.
_WIDE_JITTER = 0.7


class Summary(NamedTuple):
    """The state of a filter after a correction.

    Attributes:
        effective_sample_size: Of the last stage, and at most the number of distinct particles after the earlier ones.
        temperature: Share of the temperature that all stages used.
        degenerate: No particle was possible.
        stages: Stages that ran.
        numbers: The state as the kernels hold it.
    """

    effective_sample_size: float
    temperature: float
    degenerate: bool
    stages: int
    numbers: np.ndarray


def is_starved(numbers: np.ndarray, settings: np.ndarray, stage: int, count: int) -> bool:
    """Tell whether even the last rung of a stage leaves too few particles with weight.

    Args:
        numbers: The state after the stage.
        settings: Numbers of the step.
        stage: The stage.
        count: Particles.
    """
    own = numbers[stage * STAGE : (stage + 1) * STAGE]
    lowest = left_of(numbers, stage) * settings[DEPTH] * LOWEST
    return bool(own[RUNG] == lowest > 0.0 and not own[DEGENERATE] and own[SAMPLE_SIZE] < settings[SHARE] * count)


class Cloud(Particles):
    """Particles whose steps are recorded.

    Args:
        backend: The device.
        capacity: Most particles.
        sensors: Most sensors of a correction.
        precision: Of their log-likelihoods.
        residual: Whether draws are those of residual resampling.

    Attributes:
        moved: Whether the motion of the last correction was started.
    """

    moved = False

    def __init__(
        self, backend: Backend, capacity: int, sensors: int, precision: np.dtype, *, residual: bool = False
    ) -> None:
        super().__init__(backend, capacity, sensors, precision, residual=residual)
        self._recordings: dict[Hashable, tuple[Recording, object]] = {}
        self._estimates, self._stages = Repeated(backend, 8), Repeated(backend, 16)
        self._uploads: list[np.ndarray] = []
        self._step = np.zeros(SETTINGS)

    def set_pool(self, poses: np.ndarray) -> None:
        """Upload the poses from which recovery injects particles."""
        self.pool = self.backend.upload(np.ascontiguousarray(poses, np.float64))
        self._recordings.clear()
        self._stages.clear()

    def upload_settings(self, settings: np.ndarray) -> None:
        """Copy the numbers of a step to the device."""
        self._step = settings
        self._uploads.append(settings)
        self.backend.upload(settings, self.settings, wait=False)
        if len(self._uploads) > 64:
            self.wait()

    def wait(self) -> None:
        """Wait for all work."""
        self.backend.synchronize()
        self._uploads.clear()

    # ---- steps

    def move(self, kind: int) -> None:
        """Move the particles now."""
        self.backend.run(self.motion(kind))
        if self.shown == self.next:
            return
        # The weights of moved particles are those that the next correction begins with.
        self.shown = self.next
        self.backend.copy(self.before, self.weight, self.count * 8) if self.backend.info.kind == "gpu" else (
            self.backend.upload(self._read(self.before, self.count), self.weight)
        )

    def correct(self, kind: int, stages: int, drawn: int, sensors: int, score: Callable[[Stage], None]) -> None:
        """Run a step: stages until nothing is left of the temperature.

        Args:
            kind: Kind of the motion that begins the step.
            stages: Most stages.
            drawn: Particles of the next step.
            sensors: Sensors that are used, the first ones of ``log_p``.
            score: Runs the launches of a stage: the motion of the first one, the log-likelihoods, and the weighing.
        """
        self.use(sensors)
        self.moved, source = False, self.next
        for number in range(stages):
            last, settings = stages == 1, self._step
            stage = Stage(source, number, stages, drawn if last else 0, None if number else kind)
            score(stage)
            if not last:
                last = self._deepen(stage, settings)[number * STAGE + LEFT] == 0.0
                self._draw(stage, drawn if last else self.count)
                if self._step is not settings:
                    self.upload_settings(settings)
            self.shown, self.next = source, 1 - source
            if last:
                break
            source = 1 - source

    def _deepen(self, stage: Stage, settings: np.ndarray) -> np.ndarray:
        """Weigh a stage on ever lower rungs, until enough particles have weight; return the state."""
        numbers = self._read(self.state, STATE)
        while settings[DEPTH] > _DEEPEST and is_starved(numbers, settings, stage.number, self.count):
            settings = settings.copy()
            settings[DEPTH] *= LOWEST
            settings[JITTER], settings[FARTHEST_X], settings[FARTHEST_THETA] = _WIDE_JITTER, math.inf, math.pi
            self.upload_settings(settings)
            self.backend.run(self.weighing(stage))
            numbers = self._read(self.state, STATE)
        return numbers

    def begin(self, kind: int) -> None:
        """Start the motion of a correction."""
        self.moved = True
        self.backend.run(self.motion(kind))

    def weigh(self, stage: Stage) -> None:
        """Run the launches of a stage after its scores."""
        self._stages.run((stage[:4], self.count, self._sensors), lambda: self.weighing(stage))

    def _draw(self, stage: Stage, drawn: int) -> None:
        """Draw into the other buffer."""
        self._stages.run((stage[:2], drawn, self.count, "draw"), lambda: self.draw(stage, drawn))

    def replay(self, stage: Stage, key: Hashable, scoring: Callable[[int], tuple[Program, object]]) -> None:
        """Run a stage as one recorded program.

        Args:
            stage: The stage.
            key: All on which the sensors' programs depend.
            scoring: Returns the program that scores the poses of a buffer, and the owners of its memory.
        """
        whole = (key, stage, self.count)
        if whole not in self._recordings:
            if len(self._recordings) > _MOST_RECORDED:
                self._recordings.clear()
            move = () if stage.kind is None else self.motion(stage.kind)
            program, owners = scoring(stage.source)
            self._recordings[whole] = self.backend.record(move + program + self.weighing(stage)), owners
        self.moved = True
        self._recordings[whole][0]()

    def explain(self) -> str:
        """Return how the last recorded step is started."""
        if not self._recordings:
            return "launches one by one"
        return next(reversed(self._recordings.values()))[0].explain()

    def resized(self, drawn: int) -> None:
        """Set the number of particles, after a step that has drawn that number."""
        self.count = drawn
        self.block = weight_block(self.backend, drawn)

    # ---- what crosses to the host

    def summary(self) -> Summary:
        """Return the state after the last correction."""
        numbers = self._read(self.state, STATE)
        used, stage, distinct = 0.0, 0, math.inf
        while True:
            own = numbers[stage * STAGE : (stage + 1) * STAGE]
            used += float(own[RUNG])
            if own[LEFT] == 0.0:
                break
            # Each copy moves by the difference of two others: m parents have at most m^3 distinct copies.
            distinct = min(distinct, float(own[SAMPLE_SIZE]) ** 3)
            stage += 1
        degenerate = bool(numbers[DEGENERATE])
        return Summary(min(float(own[SAMPLE_SIZE]), distinct), min(used, 1.0), degenerate, stage + 1, numbers)

    def shares(self, count: int) -> Any:
        """Return the weights of the shown particles, whose sum is 1, as an array of the device's library."""
        out = self.backend.blank(count, _DOUBLE)
        program = self.sums.estimate(self.poses[self.shown], self.weight, self.estimated, count)
        program += self.sums.launch("normalize_weights", count, weight=self.weight, estimate=self.estimated, share=out,
                                    particles=count)  # fmt: skip
        self.backend.run(program)
        return self.backend.lend(out, (count,), _DOUBLE)

    def moments(self, count: int) -> Any:
        """Return mean and covariance of the shown particles as an array of the device's library."""
        out = self.backend.blank(ESTIMATE, _DOUBLE)
        for again in (0, 1):
            # The second pass is right for any headings.
            self.backend.run(self.sums.estimate(self.poses[self.shown], self.weight, out, count, again))
        return self.lent(out, (MOMENTS,))

    def estimate(self, count: int) -> np.ndarray:
        """Return the kernels' estimate of the shown particles: mean, covariance, sum of weights."""
        numbers = self._estimate(count, 0)
        return self._estimate(count, 1) if numbers[WIDE_HEADINGS] else numbers

    def _estimate(self, count: int, again: int) -> np.ndarray:
        """Return the numbers after a pass of the estimate."""
        # Clouds that change their size seldom ask twice for the same.
        self._estimates.run(
            (self.shown, count, again),
            lambda: self.sums.estimate(self.poses[self.shown], self.weight, self.estimated, count, again),
        )
        return self._read(self.estimated, ESTIMATE)

    def host_poses(self, index: int, count: int) -> np.ndarray:
        """Return a copy of the poses of a buffer."""
        return self._read(self.poses[index], 3 * count).reshape(count, 3)

    def host_weights(self, count: int) -> np.ndarray:
        """Return a copy of the weights of the shown particles, before they are normalised."""
        return self._read(self.weight, count)

    def _read(self, buffer: Buffer, count: int) -> np.ndarray:
        return self.backend.download(buffer, np.empty(count))

    def lent(self, buffer: Buffer, shape: tuple[int, ...]) -> Any:
        """Return the head of a buffer as an array of the device's library."""
        return self.backend.lend(self.backend.part(buffer, 0, math.prod(shape), _DOUBLE), shape, _DOUBLE)
