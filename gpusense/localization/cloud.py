"""The particles of a filter on their device, and the programs of its steps.

Two buffers hold poses: a stage of a correction scores and weighs those of one, and draws those of the other, until no
temperature is left. On a GPU motion, scores and weights are one recorded program.
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
    ESTIMATE,
    LEFT,
    RUNG,
    SAMPLE_SIZE,
    SETTINGS,
    STAGE,
    STATE,
    WIDE_HEADINGS,
)
from gpusense.interface.flags import flags_if
from gpusense.interface.launches import Program, launch
from gpusense.localization.sums import Sums, weight_block

_DOUBLE = np.dtype(np.float64)
_MOST_RECORDED = 32


class Summary(NamedTuple):
    """The state of a filter after a correction.

    Attributes:
        effective_sample_size: Of the last stage.
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


class Stage(NamedTuple):
    """A stage of a correction.

    Attributes:
        source: Index of the buffer with its poses.
        number: Its number, from 0.
        most: Most stages of the correction.
        drawn: Particles that it draws; 0 where the number follows from its weights.
        kind: Kind of the motion before it; None where there is none.
    """

    source: int
    number: int
    most: int
    drawn: int
    kind: int | None


class Cloud:
    """Particles and weights on a device.

    Args:
        backend: The device.
        capacity: Most particles.
        sensors: Most sensors of a correction.
        precision: Of their log-likelihoods.
        residual: Whether draws are those of residual resampling.

    Attributes:
        count: Particles.
        shown: Index of the buffer with the weighted poses.
        next: Index of the buffer with the poses of the next step.
    """

    def __init__(
        self, backend: Backend, capacity: int, sensors: int, precision: np.dtype, *, residual: bool = False
    ) -> None:
        self.backend, self.capacity, self.precision, self._sensors = backend, capacity, precision, sensors
        self.count, self.shown, self.next = capacity, 0, 0
        self.block = weight_block(backend, capacity)
        # Memory that a processor shares with the host is not lent.
        make = backend.blank if backend.info.kind == "gpu" else backend.empty
        self.poses = [make(3 * capacity, _DOUBLE) for _ in range(2)]
        self.weight, self.before = make(capacity, _DOUBLE), make(capacity, _DOUBLE)
        self.log_p = [make(capacity, precision) for _ in range(sensors)]
        self.score, self.ends = backend.empty(capacity, _DOUBLE), backend.empty(capacity, _DOUBLE)
        self.sums, self.estimated = Sums(backend, capacity), backend.empty(ESTIMATE, _DOUBLE)
        self.settings, self.state = backend.empty(SETTINGS, _DOUBLE), backend.upload(np.zeros(STATE))
        self.pool = backend.upload(np.zeros(3))
        # Cumulative numbers of certain copies.
        self._copies = backend.empty(capacity, _DOUBLE) if residual else None
        self._recordings: dict[Hashable, tuple[Recording, object]] = {}
        self._estimates, self._stages = Repeated(backend, 8), Repeated(backend, 16)
        self._uploads: list[np.ndarray] = []

    @property
    def blocks(self) -> int:
        """Number of blocks of particles."""
        return -(-self.count // self.block)

    def place(self, poses: np.ndarray, weights: np.ndarray | None = None) -> None:
        """Replace all particles."""
        self.count, self.shown, self.next = len(poses), 0, 0
        self.block = weight_block(self.backend, self.count)
        w = np.ones(self.count) if weights is None else weights * (self.count / weights.sum())
        self.backend.synchronize()
        self.backend.upload(np.ascontiguousarray(poses, np.float64), self.poses[0])
        self.backend.upload(np.ascontiguousarray(w, np.float64), self.weight)
        self.backend.upload(np.ascontiguousarray(w, np.float64), self.before)

    def set_pool(self, poses: np.ndarray) -> None:
        """Upload the poses from which recovery injects particles."""
        self.pool = self.backend.upload(np.ascontiguousarray(poses, np.float64))
        self._recordings.clear()
        self._stages.clear()

    def upload_settings(self, settings: np.ndarray) -> None:
        """Copy the numbers of a step to the device."""
        self._uploads.append(settings)
        self.backend.upload(settings, self.settings, wait=False)
        if len(self._uploads) > 64:
            self.wait()

    def wait(self) -> None:
        """Wait for all work."""
        self.backend.synchronize()
        self._uploads.clear()

    # ---- programs

    def motion(self, kind: int) -> Program:
        """Return the launch that moves the particles of the next step."""
        buffer = self.poses[self.next]
        return self.sums.launch("move_particles", self.count, source=buffer, settings=self.settings, target=buffer,
                                particles=self.count, kind=kind)  # fmt: skip

    def sizes(self) -> dict[str, int]:
        """Return numbers of particles by the names of arguments."""
        return dict(particles=self.count, block=self.block)

    def numbers(self) -> dict[str, Any]:
        """Return what weights are made of, by the names of arguments."""
        return dict(score=self.score, before=self.before, settings=self.settings, state=self.state, blocks=self.blocks,
                    **self.sizes())  # fmt: skip

    def scoring(self, sensors: int) -> Program:
        """Return the launches that add up the log-likelihoods of sensors."""
        flags = flags_if(FLOAT64=self.precision == np.float64)
        return tuple(
            launch("add_scores", flags, (self.blocks,), log_p=log_p, settings=self.settings, score=self.score,
                   largest=self.sums.largest, sensor=sensor, **self.sizes())
            for sensor, log_p in enumerate(self.log_p[:sensors])
        )  # fmt: skip

    def drawing(
        self, source: tuple[Buffer, Buffer, int], target: Buffer, drawn: int, stage: int, copies: Buffer | None = None
    ) -> Program:
        """Return the launch that draws from poses with cumulative weights, given with their number."""
        poses, ends, count = source
        copies = next(one for one in (copies, self._copies, ends) if one is not None)
        return self.sums.launch("draw_particles", drawn, source=poses, weight=self.weight, ends=ends, copies=copies,
                                settings=self.settings, state=self.state, pool=self.pool, target=target,
                                after=self.before, particles=count, drawn=drawn, stage=stage)  # fmt: skip

    def weighing(self, stage: Stage) -> Program:
        """Return the launches of a stage after its scores: weights, and the draw where its size is known."""
        find, *scored = self.sums.highest(self.blocks)
        found, numbers = (scored[0], scored[1]), self.numbers()
        weights = self.sums.weigh(numbers, found, stage.number)
        weights += self.sums.set_weights(numbers, found, (stage.number, stage.most), (self.weight, self.ends))
        draw = self.draw(stage, stage.drawn) if stage.drawn else ()
        return self.scoring(self._sensors) + find + weights + draw

    def draw(self, stage: Stage, drawn: int) -> Program:
        """Return the launches that draw into the other buffer."""
        copies: Program = ()
        if self._copies is not None:
            given = {name: self.numbers()[name] for name in ("state", "particles", "block", "blocks")}
            copies = self.sums.copies(dict(given, ends=self.ends), self._copies, drawn, stage.number)
        source, target = self.poses[stage.source], self.poses[1 - stage.source]
        return copies + self.drawing((source, self.ends, self.count), target, drawn, stage.number)

    # ---- steps

    def use(self, sensors: int) -> None:
        """Set the number of sensors of the next correction."""
        self._sensors = sensors

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
        source = self.next
        for number in range(stages):
            last = number + 1 == stages
            stage = Stage(source, number, stages, drawn if last else 0, None if number else kind)
            score(stage)
            if not last:
                last = self._read(self.state, STATE)[number * STAGE + LEFT] == 0.0
                self._draw(stage, drawn if last else self.count)
            self.shown, self.next = source, 1 - source
            if last:
                break
            source = 1 - source

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
        used, stage = 0.0, 0
        while True:
            used += float(numbers[stage * STAGE + RUNG])
            if numbers[stage * STAGE + LEFT] == 0.0:
                break
            stage += 1
        own = numbers[stage * STAGE : (stage + 1) * STAGE]
        degenerate = bool(numbers[DEGENERATE])
        return Summary(float(own[SAMPLE_SIZE]), min(used, 1.0), degenerate, stage + 1, numbers)

    def shares(self, count: int) -> Any:
        """Return the weights of the shown particles, whose sum is 1, as an array of the device's library."""
        out = self.backend.blank(count, _DOUBLE)
        program = self.sums.estimate(self.poses[self.shown], self.weight, self.estimated, count)
        program += self.sums.launch("normalize_weights", count, weight=self.weight, estimate=self.estimated, share=out,
                                    particles=count)  # fmt: skip
        self.backend.run(program)
        return self.backend.lend(out, (count,), _DOUBLE)

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
