"""Learn the temperature of a scan sensor from lessons: scans at the estimated pose, spread over several corrections.

A correction that begins a lesson only keeps its scan and estimate. The next one, or the same one among the first scans,
starts the terms of the readings at poses around the estimate, once the device has ended the step. Another one reads
them. In later corrections, while the device works on the step, the host places the terms, chooses beams, adds up their
scores, fits, and learns: one part of the oldest lesson per correction. Each of the first scans is a lesson, whose parts
all run at once. A lesson ends a fixed number of corrections later on every device.
"""

from __future__ import annotations

import copy
import functools
from typing import Any, ClassVar, NamedTuple

import numpy as np

from gpusense.backends.base import Exchange
from gpusense.backends.workspace import Packed
from gpusense.localization.defaults import DEFAULTS
from gpusense.localization.temperature import BeamCorrelation, axes_of, poses_around, scores_of, sums_of
from gpusense.models.scan.model import ScanModel

_DOUBLE = np.dtype(np.float64)
# Number of poses of a lesson; its stages.
_POSES = 7
_KEPT, _STARTED, _RECEIVED, _PLACED, _CHOSEN, _SUMMED, _SCORED, _LEARNED = range(8)


class Lesson(NamedTuple):
    """A scan that teaches the temperature, and its results so far."""

    pose: np.ndarray  # (3,) estimate
    axes: np.ndarray  # (3, 3) steps to the poses around it
    ranges: np.ndarray | None  # (K,) readings; None if the host has computed the terms
    scan: int  # number of the scan
    follows: bool  # whether the scan directly follows the previous lesson
    stage: int = _KEPT
    # Terms of the readings as the device writes them, then (7, K) terms, then chosen beams, their sums and scores.
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
        # The exchange of the last started lesson; the last lesson that was received, and its terms.
        self._exchange: Exchange | None = None
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
        return self._is_early or self.seen % 25 <= 1

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
        lesson = Lesson(pose, axes, ranges, self.seen, self.learned == self.seen - 1, stage, terms)
        self.lessons = *self.lessons, lesson
        self.learned = self.seen

    def receive(self) -> None:
        """Wait for the terms of a started lesson."""
        self.lessons = tuple([self._with_terms(one) if one.stage == _STARTED else one for one in self.lessons])

    def _with_terms(self, lesson: Lesson) -> Lesson:
        """Return a started lesson with its terms."""
        if lesson.result is not None:
            return lesson
        # A repeated correction needs them again, after another lesson has used the exchange.
        if self._received[0] is not lesson and self._exchange is not None:
            self._received = lesson, self._exchange.finish()
        return lesson._replace(result=self._received[1])

    def exchange(self) -> None:
        """Read the terms of a started lesson, and start the next lesson; the device has ended the step.

        A lesson that has just begun waits for the next correction, except among the first scans.
        """
        lessons = list(self.lessons)
        for place, lesson in enumerate(lessons):
            if lesson.stage == _STARTED:
                lessons[place] = self._with_terms(lesson)._replace(stage=_RECEIVED)
            elif lesson.stage == _KEPT and (self._is_early or lesson.scan < self.seen):
                lessons[place] = self._started(lesson)
                break
        self.lessons = tuple(lessons)

    @property
    def _is_early(self) -> bool:
        """Return whether every scan is still a lesson."""
        return self.seen <= DEFAULTS.calibrations

    def _started(self, lesson: Lesson) -> Lesson:
        """Start the terms of a lesson."""
        inputs, call = self._bound
        recording, self._exchange = call.exchange(inputs)
        given, (poses, ranges) = self._exchange.begin(), inputs.spans
        given[poses], given[ranges] = poses_around(lesson.pose, lesson.axes).reshape(-1), lesson.ranges
        self._exchange.start(recording)
        return lesson._replace(stage=_STARTED)

    def work(self, *, doubted: bool) -> None:
        """Do the next part of the oldest lesson, or all parts among the first scans; drop all if scans are doubted."""
        if doubted:
            self.lessons, self.learned = (), -1
            return
        first, *rest = self.lessons
        parts = _LEARNED if self._is_early else 1
        while parts and _RECEIVED <= first.stage < _LEARNED:
            first, parts = self._advanced(first), parts - 1
        self.lessons = tuple(rest if first.stage == _LEARNED else [first, *rest])

    def _advanced(self, lesson: Lesson) -> Lesson:
        """Return a received lesson after its next part."""
        result, stage = lesson.result, lesson.stage
        if stage == _RECEIVED:
            result = self._bound[1].terms(result, lesson.ranges)
        elif stage == _SUMMED:
            result = None if result is None else scores_of(result)
        elif stage == _CHOSEN:
            result = None if result is None else sums_of(*result)
        else:
            # A new object, since the correlation is part of the state.
            self.correlation = copy.copy(self.correlation)
            if stage == _PLACED:
                result = self.correlation.chosen(result, self._model.scanner.bearings + lesson.pose[2])
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
