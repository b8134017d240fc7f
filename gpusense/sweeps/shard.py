"""A part of a filter's particles on one device: it moves, scores, weighs and draws them.

Methods are generators that start work on the device before they yield and read its results after, so that one thread
keeps several devices busy. They take and return plain data, which crosses to other processes.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Sequence
from typing import Any

import numpy as np

from gpusense.backends.recording import Recording
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
from gpusense.localization.sensors import Sensor
from gpusense.reference.rungs import left_of, rung_of
from gpusense.sweeps.gathered import Gathered
from gpusense.sweeps.parts import Given, Marks, Part, Piece, Step

# Units in the last place within which the product of two numbers reaches a neighbour of another product.
_UNITS = 16
_DOUBLE = np.dtype(np.float64)


class Shard:
    """Particles on one device.

    Args:
        models: The filter's models on this device.
        capacity: Most particles of the shard.
        residual: Whether draws are those of residual resampling.
    """

    def __init__(self, models: Sequence[Any], capacity: int, residual: bool) -> None:
        self._sensors = [Sensor(model) for model in models]
        self._backend = self._sensors[0].backend
        self._cloud = Cloud(self._backend, max(capacity, 16), len(self._sensors), self._sensors[0].precision)
        self._part = Part(0, 0, 0, 16)
        self._settings = np.zeros(0)
        self._gathered, self._residual = Gathered(self._backend), residual
        # Ones, and numbers of a step whose only temperature is a sum of weights.
        self._ones: tuple[Any, Any] | None = None
        self._recordings: dict[Hashable, tuple[Recording, object]] = {}

    @property
    def _gpu(self) -> bool:
        return self._backend.info.kind == "gpu"

    # ---- beginnings

    def place(self, part: Part, poses: np.ndarray, state: np.ndarray) -> Step:
        """Replace the particles."""
        self._part = part
        if part.size:
            self._cloud.place(poses)
        self._cloud.count, self._cloud.block = part.size, part.block
        self._backend.upload(state, self._cloud.state)
        yield

    def set_pool(self, poses: np.ndarray) -> Step:
        """Take over the poses from which recovery injects particles."""
        self._cloud.set_pool(poses)
        yield

    # ---- a step

    def begin(self, settings: np.ndarray, kind: int | None, sensors: int) -> Step:
        """Begin a step: the numbers of the whole filter, a move, and the number of sensors that are used."""
        self._settings = settings.copy()
        self._upload_settings(self._part)
        if kind is not None and self._part.size:
            if sensors:
                self._cloud.use(sensors)
                self._backend.run(self._cloud.motion(kind))
            else:
                self._cloud.move(kind)
        yield

    def _upload_settings(self, drawn: Part, share: float | None = None) -> None:
        """Upload the numbers of the step for the particles of a part, with another share where one is given."""
        settings = self._settings.copy()
        settings[FIRST], settings[WHOLE], settings[DRAWN] = drawn.first, self._part.whole, drawn.whole
        if share is not None:
            settings[SHARE] = share
        self._backend.upload(settings, self._cloud.settings)

    def score(self, source: int, given: Sequence[Given]) -> Step:
        """Score the poses of a buffer by readings, and return the largest score."""
        cloud, part = self._cloud, self._part
        if not part.size:
            yield
            return -math.inf
        if self._gpu and all(self._sensors[index].records(reading) for index, reading in given):
            for index, reading in given:
                self._sensors[index].upload(reading)
            self._recorded(source, given)()
        else:
            for place, (index, reading) in enumerate(given):
                self._sensors[index].score(self._poses(source), reading, self._scores(place))
            self._backend.run(cloud.scoring(len(given)))
        yield
        return float(self._read(cloud.sums.largest, cloud.blocks).max())

    def _recorded(self, source: int, given: Sequence[Given]) -> Recording:
        """Return the recorded program that scores a buffer; its start does not wait, so that devices work together."""
        sensors = tuple((index, self._sensors[index].version) for index, _ in given)
        key = (source, self._part.size, self._part.block, sensors)
        if key not in self._recordings:
            if len(self._recordings) > 8:
                self._recordings.clear()
            program: Program = ()
            poses, owners = self._poses(source), []
            for place, (index, _) in enumerate(given):
                out = self._scores(place)
                launches, owner = self._sensors[index].program(poses, out)
                program += launches
                owners.append((out, owner))
            program += self._cloud.scoring(len(given))
            self._recordings[key] = self._backend.record(program), (poses, owners)
        return self._recordings[key][0]

    def _poses(self, source: int) -> Any:
        return self._backend.view(self._cloud.poses[source], (self._part.size, 3), _DOUBLE)

    def _scores(self, place: int) -> Any:
        return self._backend.view(self._cloud.log_p[place], (self._part.size,), self._cloud.precision)

    def weigh(self, high: float, stage: int) -> Step:
        """Return the sums of integer weights, given the largest score of the whole filter."""
        cloud, part = self._cloud, self._part
        if not part.size:
            yield
            return np.zeros(WEIGHT_SUMS)
        self._backend.upload(np.array([high]), cloud.sums.largest)
        self._backend.run(cloud.sums.weigh(cloud.numbers(), (cloud.sums.largest, 1), stage))
        yield
        return self._read(cloud.sums.totals, WEIGHT_SUMS)

    def set_weights(
        self, source: int, totals: np.ndarray, state: np.ndarray, place: tuple[int, int], offset: float, marks: Marks
    ) -> Step:
        """Set the weights by the sums and the state of the whole filter; return the particles that draws need.

        Args:
            source: Buffer of the poses.
            totals: Sums of the whole filter.
            state: Its state after this stage.
            place: The stage, and the most stages.
            offset: Sum of the weights of the shards before.
            marks: The lowest and the highest mark that each shard draws at; None where nothing is drawn.

        Returns:
            For each pair of marks, poses and cumulative weights of the particles from the one to the other.
        """
        cloud, part, stage = self._cloud, self._part, place[0]
        cloud.shown, cloud.next = source, 1 - source
        if part.size:
            self._choose_rung(totals, left_of(state, stage))
            self._backend.upload(totals, cloud.sums.totals)
            out = cloud.weight, cloud.ends
            self._backend.run(cloud.sums.set_weights(cloud.numbers(), place, out))
        yield
        # The kernel knows the number of particles of the shard only: the state is that of the filter.
        self._backend.upload(state, cloud.state)
        if marks is None or not part.size:
            return [(np.empty((0, 3)), np.empty(0))] * len(marks or ())
        ends, poses = self._read(cloud.ends, part.size) + offset, cloud.host_poses(source, part.size)
        begins, finals = (np.searchsorted(ends, side, side="right") for side in np.array(marks).T)
        return [(poses[a : b + 1], ends[a : b + 1]) for a, b in zip(begins, finals, strict=True)]

    def _choose_rung(self, totals: np.ndarray, left: float) -> None:
        """Set the share at which the kernel, which counts the shard's particles, takes the rung of the whole filter."""
        if not left > 0.0:
            return
        count, least = float(self._part.size), self._settings[SHARE] * self._part.whole
        wanted, share = rung_of(totals, self._settings, least), least / count
        for _ in range(_UNITS):
            found = rung_of(totals, self._settings, share * count)
            if found == wanted:
                break
            # A unit in the last place off.
            share = float(np.nextafter(share, math.inf if found < wanted else 0.0))
        else:
            raise RuntimeError(f"weights: must have a share for rung {wanted} of {count:g} particles, got none")
        self._upload_settings(self._part, share)

    def shift_ends(self, offset: float) -> Step:
        """Add the weights of the shards before to the cumulative weights on the device, and wait."""
        cloud, part = self._cloud, self._part
        if part.size and offset:
            if self._ones is None:
                self._ones = self._backend.upload(np.ones(cloud.capacity)), self._backend.empty(SETTINGS, _DOUBLE)
            (ones, factor), settings = self._ones, np.zeros(SETTINGS)
            settings[TEMPERATURE + 1] = offset
            self._backend.upload(settings, factor)
            # The kernel adds a multiple of an array to another: these integers are exact.
            self._backend.run((
                launch("add_scores", flags_if(FLOAT64=True), (cloud.blocks,), log_p=ones,
                       settings=factor, score=cloud.ends, largest=cloud.sums.largest, sensor=1,
                       particles=part.size, block=part.block),
            ))  # fmt: skip
        yield
        self._backend.synchronize()

    def take(self, source: int, shards: Sequence[Shard]) -> Step:
        """Copy the particles of all shards from device to device."""
        self._gathered.reserve(self._part.whole, self._part.whole)
        for one in shards:
            self._gathered.take(one._cloud.poses[source], one._cloud.ends, one._part.first, one._part.size)
        yield

    def reaches(self, other: Shard) -> bool:
        """Tell whether the device copies from the device of another shard."""
        return self._gpu and self._backend.copies_from(other._backend)

    def draw(self, source: int, stage: int, drawn: Part, pieces: Sequence[Piece] | bool) -> Step:
        """Draw the particles of the next stage or step.

        Args:
            source: Buffer of the poses.
            stage: The stage.
            drawn: Particles to draw.
            pieces: Poses and cumulative weights of shards in their order; True for those that the device has taken, and
                False to copy the own ones.
        """
        cloud, found = self._cloud, self._gathered
        of: tuple[Any, Any, int] = cloud.poses[source], cloud.ends, self._part.size
        if pieces is not False:
            if pieces is not True:
                found.upload(pieces, self._part.whole)
            of = found.poses, found.ends, found.count
        if drawn.size:
            self._upload_settings(drawn)
            counting: Program = ()
            copies = None
            if self._residual and pieces is not False:
                counting, copies = found.copies(cloud.state, drawn.whole, stage)
            self._backend.run(counting + cloud.drawing(of, cloud.poses[1 - source], drawn.size, stage, copies))
        self._part, cloud.count, cloud.block = drawn, drawn.size, drawn.block
        yield

    # ---- results

    def poses(self, index: int, count: int) -> Step:
        """Return poses of a buffer."""
        yield
        return self._cloud.host_poses(index, count)

    def weights(self, count: int) -> Step:
        """Return the weights of the shown particles."""
        yield
        return self._cloud.host_weights(count)

    def sum_poses(self, index: int, count: int, block: int, reference: np.ndarray) -> Step:
        """Return (blocks, 13) sums of weighted poses relative to a reference pose."""
        cloud, blocks = self._cloud, -(-count // block)
        if not count:
            yield
            return np.empty((0, ESTIMATE_SUMS))
        estimate = np.zeros(ESTIMATE)
        estimate[:3] = reference
        self._backend.upload(estimate, cloud.estimated)
        self._backend.run(
            cloud.sums.launch("sum_poses", blocks, poses=cloud.poses[index], weight=cloud.weight,
                              estimate=cloud.estimated, sums=cloud.sums.rows, particles=count, block=block,
                              lanes=ESTIMATE_LANES, again=1),
        )  # fmt: skip
        yield
        return self._read(cloud.sums.rows, blocks * ESTIMATE_SUMS).reshape(blocks, ESTIMATE_SUMS)

    def _read(self, buffer: Any, count: int) -> np.ndarray:
        return self._backend.download(buffer, np.empty(count))
