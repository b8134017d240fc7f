"""Learn the temperature of a scan sensor from lessons: scans at the estimated pose, spread over several corrections.

A correction that begins a lesson only keeps its scan and estimate. The next one places poses around the estimate while
the device works on the step, and then starts the terms of the readings there. Another one reads them. In later
corrections, while the device works on the step, the host fits the scores and learns: one part of the oldest lesson per
correction, short enough for the wait. Each of the first scans is a lesson, and all its parts run at once. A lesson ends
a fixed number of corrections later on every device.
"""

from __future__ import annotations

import copy
import functools
from typing import Any, ClassVar, NamedTuple

import numpy as np

from gpusense.backends.base import Exchange
from gpusense.backends.workspace import Packed
from gpusense.localization.defaults import DEFAULTS
from gpusense.localization.temperature import PARTS, BeamCorrelation, TaughtScan, axes_of, poses_around, sectors_of
from gpusense.models.scan.model import ScanModel

_DOUBLE = np.dtype(np.float64)
# Number of poses of a lesson; its stages, of which the last ones are the parts after the terms.
_POSES = 7
_KEPT, _PLACED, _STARTED, _RECEIVED, _PARTS = range(5)
_LAST = _PARTS + len(PARTS) + 1


class Lesson(NamedTuple):
    """A scan that teaches the temperature, and its results so far."""

    pose: np.ndarray  # (3,) estimate
    covariance: np.ndarray  # (3, 3) its covariance
    ranges: np.ndarray | None  # (K,) readings; None if the host has computed the terms
    scan: int  # number of the scan
    follows: bool  # whether the scan directly follows the previous lesson
    stage: int = _KEPT
    axes: Any = None  # (3, 3) steps to the poses around the estimate; None before they are placed
    around: Any = None  # (7, 3) these poses
    columns: Any = None  # columns of the evaluated readings, and of readings with a constant term
    result: Any = None  # terms of the readings as the device writes them, then the taught scan; None of too few beams


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
        lesson = Lesson(pose, covariance, ranges, self.seen, self.learned == self.seen - 1)
        if ranges is None or self._bound[1] is None:
            axes = axes_of(covariance)
            terms = np.asarray(self._model.log_likelihood(poses_around(pose, axes), *reading, per_beam=True)[1])
            lesson = lesson._replace(axes=axes, stage=_PARTS, result=self._taught(terms, lesson, axes))
        self.lessons = *self.lessons, lesson
        self.learned = self.seen

    def _taught(self, terms: np.ndarray, lesson: Lesson, axes: np.ndarray) -> TaughtScan:
        """Return the scan of a lesson with (7, K) terms of its readings."""
        directions = self._model.scanner.bearings + lesson.pose[2]
        return TaughtScan(terms.astype(np.float64), axes, directions, self._sectors, lesson.follows)

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
            elif lesson.stage < _STARTED and (self._is_early or lesson.stage == _PLACED):
                lessons[place] = self._started(lesson)
                break
        self.lessons = tuple(lessons)

    @property
    def _is_early(self) -> bool:
        """Return whether every scan is still a lesson."""
        return self.seen <= DEFAULTS.calibrations

    def _placed(self, lesson: Lesson) -> Lesson:
        """Class the readings of a lesson, and place poses around its estimate."""
        axes = axes_of(lesson.covariance)
        around, columns = poses_around(lesson.pose, axes), self._bound[1].columns(lesson.ranges)
        return lesson._replace(stage=_PLACED, axes=axes, around=around, columns=columns)

    def _started(self, lesson: Lesson) -> Lesson:
        """Start the terms of a lesson."""
        lesson = self._placed(lesson) if lesson.stage == _KEPT else lesson
        inputs, call = self._bound
        recording, self._exchange = call.exchange(inputs)
        given, (poses, ranges) = self._exchange.begin(), inputs.spans
        given[poses], given[ranges] = lesson.around.reshape(-1), lesson.ranges
        self._exchange.start(recording)
        return lesson._replace(stage=_STARTED)

    def work(self, *, doubted: bool) -> None:
        """Do the next part of the oldest lesson, or all parts among the first scans; drop all if scans are doubted.

        If the device works on the oldest lesson, do the next part of the lesson after it.
        """
        if doubted:
            self.lessons, self.learned = (), -1
            return
        lessons, parts = list(self.lessons), _LAST if self._is_early else 1
        for place, lesson in enumerate(lessons):
            while parts and (lesson.stage == _KEPT or _RECEIVED <= lesson.stage < _LAST):
                lesson, parts = self._advanced(lesson), parts - 1
            lessons[place] = lesson
        self.lessons = tuple([one for one in lessons if one.stage < _LAST])

    def _advanced(self, lesson: Lesson) -> Lesson:
        """Return a kept or received lesson after its next part."""
        result, stage = lesson.result, lesson.stage
        if stage == _KEPT:
            return self._placed(lesson)
        if stage == _RECEIVED:
            result = self._taught(self._bound[1].terms(result, lesson.columns), lesson, lesson.axes)
        elif stage == _LAST - 1:
            # A new object, since the correlation is part of the state.
            self.correlation = copy.copy(self.correlation)
            self.correlation.learn(result)
        elif result is not None:
            result = PARTS[stage - _PARTS](result)
        return lesson._replace(stage=stage + 1, result=result)

    @functools.cached_property
    def _sectors(self) -> int:
        """Number of sectors of the world for comparing scans."""
        return sectors_of(self._model.scanner.bearings) if self._model.scanner.count > 1 else 0

    @functools.cached_property
    def _bound(self) -> tuple[Packed, Any]:
        """Poses and readings of a lesson on the device, and the call that scores them; None if the host must score."""
        backend, count, precision = self._model.backend, self._model.scanner.count, np.dtype(self._model.precision)
        inputs = Packed(backend, (3 * _POSES, count))
        poses = backend.view(inputs.parts[0], (_POSES, 3), _DOUBLE)
        out = backend.view(backend.empty_external(_POSES, precision), (_POSES,), precision)
        return inputs, self._model.bind_terms(poses, backend.view(inputs.parts[1], (count,), _DOUBLE), out)
