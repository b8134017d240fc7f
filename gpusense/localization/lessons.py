"""Learn the temperature of a scan sensor from lessons: scans at the estimated pose, spread over several corrections.

A correction that begins a lesson only keeps its scan and estimate. In later corrections, while the device works on the
step, the host first starts the terms of the readings at poses around the estimate, behind the launches of the step,
then computes their scores in three parts, and then adds them to the correlation. A correction does one part of the
oldest lesson. The first scans are all lessons; then a correction ends one and starts the next. A lesson therefore ends
a fixed number of corrections later on every device.
"""

from __future__ import annotations

import copy
import functools
from typing import Any, ClassVar, NamedTuple

import numpy as np

from gpusense.backends.workspace import Packed
from gpusense.localization.defaults import DEFAULTS
from gpusense.localization.temperature import BeamCorrelation, axes_of, poses_around, scores_of
from gpusense.models.scan.model import ScanModel

_DOUBLE = np.dtype(np.float64)
# Number of poses of a lesson; its stages.
_POSES = 7
_KEPT, _STARTED, _PLACED, _SUMMED, _SCORED, _LEARNED = range(6)


class Lesson(NamedTuple):
    """A scan that teaches the temperature, and its results so far."""

    pose: np.ndarray  # (3,) estimate
    axes: np.ndarray  # (3, 3) steps to the poses around it
    ranges: np.ndarray | None  # (K,) readings; None if the host has computed the terms
    follows: bool  # whether the scan directly follows the previous lesson
    stage: int = _KEPT
    # Terms of the readings as the device writes them, then (7, K) terms, then their sums and scores.
    result: Any = None


class Learner:
    """Temperature of a scan sensor, a number or learned from its scans."""

    MEMORY: ClassVar[tuple[str, ...]] = ("correlation", "seen", "learned", "lessons")

    def __init__(self, model: ScanModel) -> None:
        self._model = model
        self.correlation = BeamCorrelation()
        # A temperature and its correlation; learning replaces the correlation.
        self._known: tuple[BeamCorrelation, float] | None = None
        # Number of scans, and the number of the last lesson's scan.
        self.seen, self.learned = 0, -1
        self.lessons: tuple[Lesson, ...] = ()
        # The recording that scores readings, and its exchange, once a lesson needs them; the last started lesson that
        # was received, and its terms.
        self._ready: Any = None
        self._received: tuple[Lesson | None, Any] = None, None

    @property
    def temperature(self) -> float:
        """The present temperature of the log-likelihood."""
        if self._known is None or self._known[0] is not self.correlation:
            self._known = self.correlation, self.correlation.temperature(self._model.used_beams)
        return self._known[1]

    def restart(self) -> None:
        """Reset the count of scans, and drop all lessons."""
        self.seen, self.learned, self.lessons = 0, -1, ()

    def count(self) -> bool:
        """Count a scan; return whether it is due as a lesson: each of the first, then two in 25."""
        self.seen += 1
        return self.seen <= DEFAULTS.calibrations or self.seen % 25 <= 1

    def begin(
        self, pose: np.ndarray, covariance: np.ndarray, reading: tuple[Any, ...], ranges: np.ndarray | None
    ) -> None:
        """Begin the lesson of the last counted scan at the estimated pose.

        ``ranges``: its readings on the host, for a recorded program; None where the model must prepare them.
        """
        axes, terms = axes_of(covariance), None
        if ranges is None or self._bound[1] is None:
            around = poses_around(pose, axes)
            terms = np.asarray(self._model.log_likelihood(around, *reading, per_beam=True)[1], np.float64)
        stage = _KEPT if terms is None else _PLACED
        lesson = Lesson(pose, axes, ranges, self.learned == self.seen - 1, stage, terms)
        self.lessons = *self.lessons, lesson
        self.learned = self.seen

    def receive(self) -> None:
        """Complete the terms of a started lesson, and let the program of the next one follow changes of the map."""
        may_start = 2 if self.seen <= DEFAULTS.calibrations else 1
        for number, lesson in enumerate(self.lessons[:may_start]):
            if lesson.stage == _KEPT:
                self._ready = self._bound[1].exchange(self._bound[0])
                return
            if lesson.stage == _STARTED and lesson.result is None:
                # A repeated correction needs them again, after another lesson has used the exchange.
                if self._received[0] is not lesson:
                    self._received = lesson, self._ready[1].finish()
                received = lesson._replace(result=self._received[1])
                self.lessons = *self.lessons[:number], received, *self.lessons[number + 1 :]

    def work(self, *, doubted: bool) -> None:
        """Continue the oldest lesson, or end and start lessons of the first scans; drop all if scans are doubted."""
        if doubted:
            self.lessons, self.learned = (), -1
            return
        first, *rest = self.lessons
        if first.stage == _KEPT or self.seen > DEFAULTS.calibrations:
            first = self._advanced(first)
        else:
            while first.stage < _LEARNED:
                first = self._advanced(first)
            rest[:1] = [self._advanced(one) for one in rest[:1] if one.stage == _KEPT] or rest[:1]
        self.lessons = tuple(rest if first.stage == _LEARNED else [first, *rest])

    def _advanced(self, lesson: Lesson) -> Lesson:
        """Return a lesson after its next stage; the device completes started terms before it is idle."""
        result, stage = lesson.result, lesson.stage
        if stage == _KEPT:
            (recording, exchange), (poses, ranges) = self._ready, self._bound[0].spans
            given = exchange.begin()
            given[poses], given[ranges] = poses_around(lesson.pose, lesson.axes).reshape(-1), lesson.ranges
            exchange.start(recording)
        elif stage == _STARTED:
            result = self._bound[1].terms(result, lesson.ranges)
        elif stage == _SUMMED:
            result = None if result is None else scores_of(result)
        else:
            # A new object, since the correlation is part of the state.
            self.correlation = copy.copy(self.correlation)
            if stage == _PLACED:
                result = self.correlation.summed(result, self._model.scanner.bearings + lesson.pose[2])
            else:
                self.correlation.learn(result, lesson.axes, follows=lesson.follows)
        return lesson._replace(stage=stage + 1, result=result)

    @functools.cached_property
    def _bound(self) -> tuple[Packed, Any]:
        """Poses and readings of a lesson on the device, and the call that scores them; None if the host must score."""
        backend, count, precision = self._model.backend, self._model.scanner.count, np.dtype(self._model.precision)
        inputs = Packed(backend, (3 * _POSES, count))
        poses = backend.view(inputs.parts[0], (_POSES, 3), _DOUBLE)
        out = backend.view(backend.empty_external(_POSES, precision), (_POSES,), precision)
        return inputs, self._model.bind_terms(poses, backend.view(inputs.parts[1], (count,), _DOUBLE), out)
