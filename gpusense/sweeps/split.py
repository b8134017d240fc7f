"""The particles of one filter on several devices, as the cloud of a particle filter."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from gpusense.backends.base import Backend
from gpusense.interface.constants import (
    ESTIMATE,
    ESTIMATE_SUMS,
    LEFT,
    RESAMPLED,
    SETTINGS,
    SHARE,
    STAGE,
    STATE,
    TOTAL,
    WEIGHT_SUMS,
    WIDE_HEADINGS,
)
from gpusense.localization.cloud import Cloud
from gpusense.localization.sums import fans_of
from gpusense.reference.draws import mark_of
from gpusense.reference.estimate import finish_estimate
from gpusense.reference.rungs import column_of, left_of, possible_of, rung_of, set_stage
from gpusense.reference.weighing import join_rows
from gpusense.sweeps.parts import Given, Part, parts_of
from gpusense.sweeps.teams import Here, There

_PLAIN = frozenset[str]()
# Bytes of a pose and a cumulative weight.
_PARTICLE = 32


class SplitCloud(Cloud):
    """Particles over several shards, with the interface of the cloud of one device.

    A stage of a correction has two exchanges, of the largest score and of the sums of integer weights, and a third one
    of particles where it draws: without jitter each shard gets the parents of its own particles; with jitter, and in
    residual resampling, all.

    Args:
        team: The shards.
        backend: Device of the estimates.
        capacity: Most particles of the filter.
        precision: Of log-likelihoods.
        residual: Whether draws are those of residual resampling.

    Attributes:
        exchanged: Bytes of particles that were handed to shards.
    """

    def __init__(
        self, team: Here | There, backend: Backend, capacity: int, precision: np.dtype, *, residual: bool = False
    ) -> None:
        self.backend, self.capacity, self.precision, self._team = backend, capacity, precision, team
        self._residual = residual
        self.shown, self.next, self.exchanged = 0, 0, 0
        # The filter sets it to zero when it begins; the state itself is on the host.
        self.state = backend.upload(np.zeros(STATE))
        self._numbers, self._settings = np.zeros(STATE), np.zeros(SETTINGS)
        self.resized(capacity)

    @property
    def _size(self) -> int:
        return len(self._team.devices)

    def resized(self, drawn: int) -> None:
        """Set the number of particles."""
        self._parts = parts_of(drawn, self._size)
        self.count, self.block = drawn, self._parts[0].block

    def _all(self, method: str, *arguments: Any) -> list[Any]:
        return self._team.each(method, [arguments] * self._size)

    # ---- beginnings

    def place(self, poses: np.ndarray, weights: np.ndarray | None = None) -> None:
        """Replace all particles."""
        if weights is not None:
            raise NotImplementedError("particles with weights cannot be split")
        self.resized(len(poses))
        self.shown, self.next, self._numbers = 0, 0, np.zeros(STATE)
        own = [(part, poses[part.first : part.first + part.size], self._numbers) for part in self._parts]
        self._team.each("place", own)

    def set_pool(self, poses: np.ndarray) -> None:
        """Send the poses from which recovery injects particles."""
        self._all("set_pool", poses)

    def upload_settings(self, settings: np.ndarray) -> None:
        """Keep the numbers of the next step."""
        self._settings = settings

    # ---- steps

    def move(self, kind: int) -> None:
        """Move the particles now."""
        self._all("begin", self._settings, kind, 0)
        self.shown = self.next

    def step(self, kind: int, stages: int, drawn: int, given: Sequence[Given]) -> None:
        """Run a correction.

        Args:
            kind: Kind of the motion that begins the step.
            stages: Most stages.
            drawn: Particles of the next step.
            given: Indices of sensors with their readings.
        """
        self.moved = True
        self._all("begin", self._settings, kind, len(given))
        source = self.next
        for stage in range(stages):
            self._stage(source, (stage, stages), drawn, given)
            self.shown, self.next = source, 1 - source
            source = 1 - source
            if self._numbers[stage * STAGE + LEFT] == 0.0:
                break

    def _stage(self, source: int, place: tuple[int, int], last: int, given: Any) -> None:
        """Score and weigh the particles of a buffer, and draw into the other one: ``last`` where nothing is left."""
        stage, state = place[0], self._numbers
        high = max(self._all("score", source, given))
        each = self._all("weigh", high, stage)
        totals = np.zeros(WEIGHT_SUMS)
        join_rows(_PLAIN, np.concatenate(each), totals, self._size, WEIGHT_SUMS, self._size)
        left, high = left_of(state, stage), possible_of(totals, high)
        rung = rung_of(totals, self._settings, self._settings[SHARE] * self.count) if left > 0.0 else 0
        set_stage(totals, self._settings, state, high, left, rung, self.count, *place)
        drawn = self._parts if state[stage * STAGE + LEFT] > 0.0 else parts_of(last, self._size)
        marks = self._marks(stage, drawn)
        offsets = np.cumsum([0.0, *(one[column_of(high, rung)] for one in each[:-1])])
        shown = state.copy()
        if marks is not None:
            # A filter that changes its size draws, whatever its weights.
            shown[stage * STAGE + RESAMPLED] = 1.0
        asked = None if self._team.direct else marks
        own = [(source, totals, shown, place, float(offset), asked) for offset in offsets]
        found = self._team.each("set_weights", own)
        pieces: list[Any] = [False] * self._size
        if marks is not None and self._team.direct:
            self._team.each("shift_ends", [(float(offset),) for offset in offsets])
            self._team.hand_on(source)
            pieces = [True] * self._size
            self.exchanged += (self._size - 1) * self.count * _PARTICLE
        elif marks is not None:
            pieces = [[one[target] for one in found] for target in range(self._size)]
            self.exchanged += sum(
                one.nbytes for target, each in enumerate(pieces) for origin, piece in enumerate(each)
                for one in piece if origin != target
            )  # fmt: skip
        self._team.each("draw", [(source, stage, *pair) for pair in zip(drawn, pieces, strict=True)])

    def _marks(self, stage: int, drawn: list[Part]) -> list[tuple[float, float]] | None:
        """Return the lowest and the highest mark that each shard draws at; None where each copies its own particles."""
        own = self._numbers[stage * STAGE : (stage + 1) * STAGE]
        total, whole = float(own[TOTAL]), drawn[0].whole
        if not total > 0.0 and whole != self.count:
            raise RuntimeError("the weights of all particles are 0, so their number cannot change")
        if (own[RESAMPLED] == 0.0 and whole == self.count) or not total > 0.0:
            return None
        if own[LEFT] > 0.0 or self._residual:
            # Jitter takes differences of any two particles; the last residual draws may be of any particle.
            return [(-1.0, total)] * self._size
        ends = [(part.first / whole, (part.first + part.size) / whole) for part in drawn]
        return [(float(mark_of(np.array(low), total)), float(mark_of(np.array(high), total))) for low, high in ends]

    def explain(self) -> str:
        """Return how the particles are split."""
        counts = ", ".join(f"{part.size} on {name}" for part, name in zip(self._parts, self._team.devices, strict=True))
        return f"split: {counts}"

    # ---- what crosses to the host

    def estimate(self, count: int) -> np.ndarray:
        """Return the estimate of the shown particles: mean, covariance, sum of weights."""
        parts, result = parts_of(count, self._size), np.zeros(ESTIMATE)
        holder = next(index for index, part in enumerate(parts) if part.size)
        asked = [(self.shown, 1 if index == holder else 0) for index in range(self._size)]
        first = self._team.each("poses", asked)[holder][0]
        for again in (0, 1):
            reference = result[:3].copy() if again else first
            table = np.concatenate(
                self._team.each("sum_poses", [(self.shown, part.size, part.block, reference) for part in parts])
            )
            for fan in fans_of(len(table)):
                sums, table = table.reshape(-1), np.empty((-(-len(table) // fan), ESTIMATE_SUMS))
                join_rows(_PLAIN, sums, table.reshape(-1), len(sums) // ESTIMATE_SUMS, ESTIMATE_SUMS, fan)
            finish_estimate(_PLAIN, first, table.reshape(-1), result, 1, again)
            if not result[WIDE_HEADINGS]:
                break
        return result

    def host_poses(self, index: int, count: int) -> np.ndarray:
        """Return a copy of the poses of a buffer."""
        return np.concatenate(self._team.each("poses", [(index, one.size) for one in parts_of(count, self._size)]))

    def host_weights(self, count: int) -> np.ndarray:
        """Return a copy of the weights of the shown particles, before they are normalised."""
        return np.concatenate(self._team.each("weights", [(one.size,) for one in parts_of(count, self._size)]))

    def _read(self, buffer: Any, count: int) -> np.ndarray:
        # The state, for the summary.
        return self._numbers[:count].copy()

    def close(self) -> None:
        """Forget the shards."""
        self._team.close()
