"""The particles of one filter on several devices."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

from gpusense.interface.constants import (
    ESTIMATE,
    ESTIMATE_SUMS,
    LEFT,
    MOMENTS,
    RESAMPLED,
    SHARE,
    STAGE,
    STATE,
    TOTAL,
    WEIGHT_SUMS,
    WIDE_HEADINGS,
)
from gpusense.localization.distributed.parts import Part, parts_of
from gpusense.localization.distributed.teams import LocalTeam, RemoteTeam
from gpusense.localization.filter_cloud import (
    Contents,
    FilterCloud,
    Step,
    Summary,
    deeper,
    is_starved,
    meaningful,
    summary_of,
)
from gpusense.localization.particles import Places, Stage
from gpusense.localization.sums import reduction_fans
from gpusense.reference.draws import mark_of
from gpusense.reference.estimate import finish_estimate
from gpusense.reference.tempering import column_of, left_of, possible_of, rung_of, set_stage
from gpusense.reference.weighing import join_rows

_PLAIN = frozenset[str]()
# Bytes of a pose and a cumulative weight.
_PARTICLE = 32


class SplitCloud(FilterCloud):
    """Particles over several shards.

    Each stage of a correction exchanges the largest score, then the sums of integer weights. A stage that draws also
    exchanges particles: without jitter each shard receives the parents that it draws; with jitter or residual
    resampling it receives all parents. Each call names its particles and buffers; shards remember none, and their state
    is kept here.

    Args:
        team: The shards.
        capacity: Most particles of the filter.
        residual: Whether to draw by residual resampling.

    Attributes:
        exchanged: Bytes of particles that were handed to shards.
    """

    MEMORY: ClassVar[tuple[str, ...]] = ("count", "places", "exchanged", "_state", "_pool")
    PARTS: ClassVar[tuple[str, ...]] = ()

    def __init__(self, team: LocalTeam | RemoteTeam, capacity: int, *, residual: bool = False) -> None:
        self._team, self._residual = team, residual
        self.count, self.places, self.kept, self.exchanged = capacity, Places(), Places(), 0
        self._state = np.zeros(STATE)
        self._pool: np.ndarray | None = None

    @property
    def _size(self) -> int:
        return len(self._team.devices)

    def _parts(self, count: int) -> list[Part]:
        return parts_of(count, self._size)

    def _all(self, method: str, *arguments: Any) -> list[Any]:
        return self._team.each(method, [arguments] * self._size)

    def _set(self, places: Places, count: int, state: np.ndarray) -> None:
        """Set everything that a step changes."""
        self.places, self.count, self._state = places, count, state

    # ---- steps

    def place(self, poses: np.ndarray) -> None:
        places, count = self.places.placed(self.kept), len(poses)
        self._fill([("poses", places.shown, poses), ("weights", places.weight, np.ones(count))])
        self._set(places, count, np.zeros(STATE))

    def _fill(self, arrays: list[tuple[str, int, np.ndarray]]) -> None:
        """Copy to the buffers of each shard its part of arrays."""
        parts = [self._parts(len(array)) for _, _, array in arrays]
        self._team.each("fill", [
            ([(name, index, array[own.first : own.first + own.size])
              for (name, index, array), own in zip(arrays, each, strict=True)],)
            for each in zip(*parts, strict=True)
        ])  # fmt: skip

    def set_pool(self, poses: np.ndarray) -> None:
        self._all("set_pool", poses)
        self._pool = poses

    def move(self, settings: np.ndarray, kind: int) -> None:
        places = self.places.moved(self.kept)
        self._begin(settings, self.places.next, places.next, kind)
        self.places = places

    def _begin(self, settings: np.ndarray, origin: int, target: int, kind: int) -> None:
        self._team.each("begin", [(part, settings, origin, target, kind) for part in self._parts(self.count)])

    def correct(self, step: Step) -> None:
        stages, state = self.places.stages(self.kept, step.stages, step.drawn, step.kind), self._state.copy()
        self._begin(step.settings, stages[0].origin, stages[0].source, step.kind)
        for stage in stages:
            self._run(stage, step, state)
            if state[stage.number * STAGE + LEFT] == 0.0:
                break
        self._set(stage.places, step.drawn, state)

    def _run(self, stage: Stage, step: Step, state: np.ndarray) -> None:
        """Score and weigh the particles of a stage, and draw; the last stage draws the particles of the next step."""
        number = stage.number
        each, totals, column, settings = self._weigh(stage, step, state)
        drawn = self._parts(self.count if state[number * STAGE + LEFT] > 0.0 else step.drawn)
        marks = self._marks(state[number * STAGE : (number + 1) * STAGE], drawn)
        offsets = np.cumsum([0.0, *(one[column] for one in each[:-1])])
        shown = state.copy()
        if marks is not None:
            # A filter that changes its size always draws.
            shown[number * STAGE + RESAMPLED] = 1.0
        asked = None if self._team.direct else marks
        found = self._team.each("set_weights", [(stage, totals, shown, float(offset), asked) for offset in offsets])
        pieces = self._exchanged(stage, marks, found, offsets)
        self._team.each("draw", [(stage, *pair) for pair in zip(drawn, pieces, strict=True)])
        if settings is not step.settings:
            self._all("use_settings", step.settings)

    def _weigh(self, stage: Stage, step: Step, state: np.ndarray) -> tuple[list[Any], np.ndarray, int, np.ndarray]:
        """Score the particles, weigh them, again on lower rungs while too few have weight, and write the stage's state.

        Returns:
            Sums of weights of each shard and of all, the column that counts, and the settings that were used.
        """
        number, settings = stage.number, step.settings
        highest = max(self._all("score", stage.source, step.readings))
        while True:
            each, totals = self._all("weigh", highest, stage), np.zeros(WEIGHT_SUMS)
            join_rows(_PLAIN, np.concatenate(each), totals, self._size, WEIGHT_SUMS, self._size)
            left, high = left_of(state, number), possible_of(totals, highest)
            rung = rung_of(totals, settings, settings[SHARE] * self.count) if left > 0.0 else 0
            set_stage(totals, settings, state, high, left, rung, self.count, number, stage.most)
            if stage.most == 1 or not is_starved(state, settings, number, self.count):
                return each, totals, column_of(high, rung), settings
            settings = deeper(settings)
            self._all("use_settings", settings)

    def _exchanged(self, stage: Stage, marks: object, found: list[Any], offsets: np.ndarray) -> list[Any]:
        """Hand particles to the shards that draw from them; return the arguments of each shard's ``draw``."""
        if marks is None:
            return [False] * self._size
        if self._team.direct:
            self._team.each("shift_ends", [(float(offset),) for offset in offsets])
            self._team.hand_on(stage.source)
            self.exchanged += (self._size - 1) * self.count * _PARTICLE
            return [True] * self._size
        pieces = [[one[target] for one in found] for target in range(self._size)]
        self.exchanged += sum(
            one.nbytes for target, each in enumerate(pieces) for origin, piece in enumerate(each)
            for one in piece if origin != target
        )  # fmt: skip
        return pieces

    def _marks(self, own: np.ndarray, drawn: list[Part]) -> list[tuple[float, float]] | None:
        """Return the lowest and the highest mark of each shard's draws; None if each draws from its part alone."""
        total, whole = float(own[TOTAL]), drawn[0].whole
        if not total > 0.0 and whole != self.count:
            raise RuntimeError("the weights of all particles are 0, so their number cannot change")
        if (own[RESAMPLED] == 0.0 and whole == self.count) or not total > 0.0:
            return None
        if own[LEFT] > 0.0 or self._residual:
            # Jitter takes differences of any two particles; the last residual draws may take any particle.
            return [(-1.0, total)] * self._size
        ends = [(part.first / whole, (part.first + part.size) / whole) for part in drawn]
        return [(float(mark_of(np.array(low), total)), float(mark_of(np.array(high), total))) for low, high in ends]

    def explain(self) -> str:
        parts = zip(self._parts(self.count), self._team.devices, strict=True)
        return f"split: {', '.join(f'{part.size} on {name}' for part, name in parts)}"

    # ---- copies to the host

    def estimate(self, count: int) -> np.ndarray:
        parts, result, shown = self._parts(count), np.zeros(ESTIMATE), self.places.shown
        holder = next(index for index, part in enumerate(parts) if part.size)
        asked = [(shown, 1 if index == holder else 0) for index in range(self._size)]
        first = self._team.each("poses", asked)[holder][0]
        buffers = shown, self.places.weight
        for second_pass in (0, 1):
            reference = result[:3].copy() if second_pass else first
            table = np.concatenate(
                self._team.each("sum_poses", [(buffers, part.size, part.block, reference) for part in parts])
            )
            for fan in reduction_fans(len(table)):
                sums, table = table.reshape(-1), np.empty((-(-len(table) // fan), ESTIMATE_SUMS))
                join_rows(_PLAIN, sums, table.reshape(-1), len(sums) // ESTIMATE_SUMS, ESTIMATE_SUMS, fan)
            finish_estimate(_PLAIN, first, table.reshape(-1), result, 1, second_pass)
            if not result[WIDE_HEADINGS]:
                break
        return result

    def summary(self) -> Summary:
        return summary_of(self._state.copy())

    def particles(self, count: int) -> np.ndarray:
        """See FilterCloud.particles; in host memory."""
        return self.host_poses(self.places.shown, count)

    def shares(self, count: int) -> np.ndarray:
        """See FilterCloud.shares; in host memory."""
        weights = self.host_weights(count)
        return np.asarray(weights / weights.sum())

    def moments(self, count: int) -> np.ndarray:
        """See FilterCloud.moments; in host memory."""
        return self.estimate(count)[:MOMENTS]

    def host_poses(self, index: int, count: int) -> np.ndarray:
        return np.concatenate(self._team.each("poses", [(index, one.size) for one in self._parts(count)]))

    def host_weights(self, count: int) -> np.ndarray:
        return self._weights(self.places.weight, count)

    def _weights(self, index: int, count: int) -> np.ndarray:
        return np.concatenate(self._team.each("weights", [(index, one.size) for one in self._parts(count)]))

    def contents(self, count: int) -> Contents:
        places, weighed = self.places, self.places.shown != self.places.next
        return Contents(
            self.host_poses(places.shown, count), self.host_weights(count),
            self.host_poses(places.next, self.count) if weighed else None,
            self._weights(places.before, self.count) if weighed else None,
            meaningful(self._state, self._pool is not None),
            None if self._pool is None else self._pool.copy(),
        )  # fmt: skip

    def restore(self, contents: Contents) -> None:
        if contents.pool is not None:
            self.set_pool(contents.pool)
        places, arrays = contents.places_and_arrays(self.kept)
        self._fill(arrays)
        self._set(places, contents.next_count, contents.state.copy())

    # ---- times

    @property
    def scoring_seconds(self) -> float:
        return float(sum(self._all("scoring_seconds")))

    def time_scoring(self) -> None:
        self._all("time_scoring")

    def close(self) -> None:
        """Release the shards."""
        self._team.close()
