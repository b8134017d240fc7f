"""Hold a filter's particles on a device, and make the launches of its steps.

Four buffers hold poses and four hold weights, in two banks: a step reads from one bank and writes to the other, so that
an interrupted step has changed nothing. A stage of a correction scores and weighs the poses of a buffer, and draws into
the second buffer of its bank.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np

from gpusense.backends.base import Backend, Buffer
from gpusense.backends.workspace import Packed
from gpusense.interface.constants import ESTIMATE, SETTINGS, STATE
from gpusense.interface.flags import flags_if
from gpusense.interface.launches import Program, launch
from gpusense.localization.beam_consistency import JUDGED
from gpusense.localization.sums import Sums, weight_block

_DOUBLE = np.dtype(np.float64)
# Most views of buffers.
_MOST_VIEWS = 32


class BufferSlots(NamedTuple):
    """Buffers of a filter's particles by index."""

    shown: int = 0  # weighted poses
    next: int = 0  # poses of the next step; equal to ``shown`` if no step has weighed them
    weight: int = 1  # weights of the shown poses
    before: int = 1  # weights at the beginning of the next step
    state: int = 0  # state of the last correction

    def placed(self, kept: BufferSlots) -> BufferSlots:
        """Return buffers for new particles outside ``kept``."""
        poses, weights = kept.free()
        return BufferSlots(poses, poses, weights + 1, weights + 1, 1 - kept.state)

    def moved(self, kept: BufferSlots) -> BufferSlots:
        """Return the buffers after a motion without a correction; weights wait for the next correction."""
        poses = kept.free()[0]
        return self._replace(shown=poses, next=poses, weight=self.before)

    @functools.lru_cache(maxsize=64)  # noqa: B019 - plain values
    def stages(self, kept: BufferSlots, most: int, drawn: int, kind: int, *, same: bool = False) -> list[Stage]:
        """Return the stages of a correction; with ``same`` each stage draws the number of the next step."""
        (poses, weights), state = kept.free(), 1 - kept.state
        known = drawn if same or most == 1 else 0
        first = Stage(poses, 0, most, known, self.before, weights, state, self.next, kind)
        return [first] + [
            Stage(poses + number % 2, number, most, known, weights + 1, weights, state) for number in range(1, most)
        ]

    def free(self) -> tuple[int, int]:
        """Return the first poses and the first weights of banks without any of these buffers."""
        return 2 - self.shown // 2 * 2, 2 - self.weight // 2 * 2


class Stage(NamedTuple):
    """A stage of a correction."""

    source: int  # index of the buffer of poses; drawn particles go to the second buffer of the bank
    number: int  # number of the stage, from 0
    most: int  # most stages of the correction
    drawn: int  # number of particles to draw; 0 if the weights determine it
    before: int  # index of the weights before the stage
    weight: int  # index of the weights to set; weights of drawn particles are in the next buffer
    state: int  # index of the state to write
    origin: int = 0  # index of the poses before the motion
    kind: int | None = None  # kind of the motion before the stage; None without motion

    @property
    def key(self) -> tuple[int, ...]:
        """Key of the launches after the scores."""
        return self[:7]

    @property
    def target(self) -> int:
        """Index of the buffer for drawn particles."""
        return self.source ^ 1

    @property
    def after(self) -> int:
        """Index of the weights of drawn particles."""
        return self.weight + 1

    @property
    def places(self) -> BufferSlots:
        """The buffers after the stage."""
        return BufferSlots(self.source, self.source ^ 1, self.weight, self.weight + 1, self.state)


class Particles:
    """Particles and weights on a device, and their launches."""

    MEMORY: ClassVar[tuple[str, ...]] = ("count", "block", "places", "pool", "pool_size")

    def __init__(
        self, backend: Backend, capacity: int, readings: Sequence[int], precision: np.dtype, *, residual: bool = False
    ) -> None:
        self.backend, self.capacity, self.precision = backend, capacity, precision
        # Particles of the next step; buffers of the particles; buffers at the beginning of a call of the filter, which
        # steps never overwrite.
        self.count, self.places, self.kept = capacity, BufferSlots(), BufferSlots()
        self.block = weight_block(backend, capacity)
        # Other libraries get no memory that a processor shares with the host.
        make = backend.empty_external if backend.info.kind == "gpu" else backend.empty
        self.poses = [make(3 * capacity, _DOUBLE) for _ in range(4)]
        self.weights = [make(capacity, _DOUBLE) for _ in range(4)]
        self.log_p = [make(capacity, precision) for _ in readings]
        self.score, self.ends = backend.empty(capacity, _DOUBLE), backend.empty(capacity, _DOUBLE)
        self.sums, count = Sums(backend, capacity), len(readings)
        # One copy writes all inputs of a step: settings, readings and scans to judge. Another reads all results: two
        # states of corrections, the estimate and its second pass, and judged beams.
        self.inputs = Packed(backend, (SETTINGS, *readings, *[JUDGED] * count))
        self.settings, *more = self.inputs.parts
        self.readings, self.scans = more[:count], more[count:]
        self.results = Packed(backend, (STATE, STATE, ESTIMATE, ESTIMATE, *[JUDGED] * count))
        first, second, self.estimated, self.refined, *self.judged = self.results.parts
        self.states = [first, second]
        # Poses for recovery to inject.
        self.pool, self.pool_size = backend.upload(np.zeros(3)), 0
        # Arrays that the device may still read; views of buffers for models, by the number of particles.
        self._uploads: list[np.ndarray] = []
        self._views: dict[tuple[str, int, int], Any] = {}
        # Cumulative numbers of certain copies.
        self._copies = backend.empty(capacity, _DOUBLE) if residual else None

    @property
    def blocks(self) -> int:
        """Number of blocks of particles."""
        return -(-self.count // self.block)

    def set_particles(self, places: BufferSlots, count: int) -> None:
        """Set the buffers, the number of particles, and the number in a block of weights."""
        if count != self.count:
            self.block = weight_block(self.backend, count)
        self.places, self.count = places, count

    def keep(self) -> None:
        """Keep the present buffers in the next steps."""
        self.kept = self.places

    # ---- launches

    def motion(self, origin: int, target: int, kind: int) -> Program:
        """Return the launch that moves particles between buffers."""
        return self.sums.launch("move_particles", self.count, source=self.poses[origin], settings=self.settings,
                                target=self.poses[target], particles=self.count, kind=kind)  # fmt: skip

    def numbers(self, stage: Stage) -> dict[str, Any]:
        """Return the arguments of launches for weights, by name."""
        return dict(
            score=self.score, before=self.weights[stage.before], settings=self.settings, block=self.block,
            state=self.states[stage.state], blocks=self.blocks, particles=self.count,
        )  # fmt: skip

    def scoring(self, sensors: int) -> Program:
        """Return the launches that add up the log-likelihoods of sensors."""
        flags = flags_if(FLOAT64=self.precision == np.float64)
        return tuple(
            launch("add_scores", flags, (self.blocks,), log_p=log_p, settings=self.settings, score=self.score,
                   largest=self.sums.largest, sensor=sensor, particles=self.count, block=self.block)
            for sensor, log_p in enumerate(self.log_p[:sensors])
        )  # fmt: skip

    def weighing(self, stage: Stage, sensors: int) -> Program:
        """Return the launches of a stage after scores by sensors: weights, and the draw if the number is known."""
        find, *scored = self.sums.highest(self.blocks)
        found = scored[0], scored[1]
        numbers, out = self.numbers(stage), (self.weights[stage.weight], self.ends)
        weights = self.sums.weigh(numbers, found, stage.number)
        weights += self.sums.set_weights(numbers, (stage.number, stage.most), out)
        draw = self.draw(stage, stage.drawn) if stage.drawn else ()
        return self.scoring(sensors) + find + weights + draw

    def draw(self, stage: Stage, drawn: int) -> Program:
        """Return the launches that draw into the second buffer of the bank."""
        copies: Program = ()
        if self._copies is not None:
            numbers = {name: self.numbers(stage)[name] for name in ("state", "particles", "block", "blocks")}
            copies = self.sums.copies(dict(numbers, ends=self.ends), self._copies, drawn, stage.number)
        draw = self.sums.launch(
            "draw_particles", drawn, source=self.poses[stage.source], weight=self.weights[stage.weight],
            ends=self.ends, copies=self.ends if self._copies is None else self._copies, settings=self.settings,
            state=self.states[stage.state], pool=self.pool, target=self.poses[stage.target],
            after=self.weights[stage.after], particles=self.count, drawn=drawn, stage=stage.number,
        )  # fmt: skip
        return copies + draw

    # ---- copies and views

    def fill(self, *arrays: tuple[Buffer, np.ndarray]) -> None:
        """Copy arrays to buffers that earlier steps may still use."""
        self.backend.synchronize()
        for buffer, array in arrays:
            self.backend.upload(np.ascontiguousarray(array, np.float64), buffer)

    def upload_settings(self, settings: np.ndarray) -> None:
        """Copy the settings of a step to the device."""
        self.backend.upload(self.held(settings), self.settings, wait=False)

    def held(self, array: np.ndarray) -> np.ndarray:
        """Return an array, kept alive until the device has read it."""
        if len(self._uploads) > 64:
            self.wait()
        self._uploads.append(array)
        return array

    def wait(self) -> None:
        """Wait until the device is idle."""
        self.backend.synchronize()
        self._uploads.clear()

    def copy_state(self, source: int, target: int) -> None:
        """Start copying a state of corrections to the place of another."""
        if self.backend.info.kind == "gpu":
            self.backend.copy(self.states[source], self.states[target], STATE * _DOUBLE.itemsize)
        else:
            self.backend.upload(self._read(self.states[source], STATE), self.states[target])

    def host_poses(self, index: int, count: int) -> np.ndarray:
        """Return a copy of the poses of a buffer."""
        return self._read(self.poses[index], 3 * count).reshape(count, 3)

    def host_weights(self, count: int, index: int | None = None) -> np.ndarray:
        """Return a copy of the unnormalised weights of a buffer, by default of the shown particles."""
        return self._read(self.weights[self.places.weight if index is None else index], count)

    def _read(self, buffer: Buffer, count: int) -> np.ndarray:
        return self.backend.download(buffer, np.empty(count))

    def lent(self, buffer: Buffer, shape: tuple[int, ...]) -> Any:
        """Return the head of a buffer as an array of the device's library."""
        return self.backend.wrap_external(self.backend.part(buffer, 0, math.prod(shape), _DOUBLE), shape, _DOUBLE)

    def poses_of(self, source: int) -> Any:
        """Return the poses of a buffer for models."""
        key = ("poses", source, self.count)
        return self._views.get(key) or self._view(key, self.poses[source], (self.count, 3), _DOUBLE)

    def log_p_of(self, place: int) -> Any:
        """Return the array for a sensor's log-likelihoods."""
        key = ("log_p", place, self.count)
        return self._views.get(key) or self._view(key, self.log_p[place], (self.count,), self.precision)

    def _view(self, key: tuple[str, int, int], buffer: Buffer, shape: tuple[int, ...], dtype: np.dtype) -> Any:
        """Return a cached view of a buffer; clouds of one size have few views."""
        if len(self._views) >= _MOST_VIEWS:
            self._views.clear()
        self._views[key] = self.backend.view(buffer, shape, dtype)
        return self._views[key]
