"""The particles of a filter on their device, and the launches of its steps.

Two buffers hold poses: a stage of a correction scores and weighs those of one, and draws those of the other.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from gpusense.backends.base import Backend, Buffer
from gpusense.interface.constants import ESTIMATE, SETTINGS, STATE
from gpusense.interface.flags import flags_if
from gpusense.interface.launches import Program, launch
from gpusense.localization.sums import Sums, weight_block

_DOUBLE = np.dtype(np.float64)


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


class Particles:
    """Particles and weights on a device, and the launches that work on them.

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

    def use(self, sensors: int) -> None:
        """Set the number of sensors of the next correction."""
        self._sensors = sensors

    # ---- launches

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
        weights += self.sums.set_weights(numbers, (stage.number, stage.most), (self.weight, self.ends))
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
