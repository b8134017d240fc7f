"""Recover a filter from a wrong pose by rivals of its particles, searched when scans contradict the pose."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from gpusense.localization import starts
from gpusense.localization.cloud_state import SensorReadings
from gpusense.localization.motion import SampledMotion
from gpusense.localization.rival import COMPARISONS, PARTICLES, PRIOR, Rival, evidence_of
from gpusense.localization.rival_search import can_search
from gpusense.localization.scoring import FilterCloud
from gpusense.localization.tracker import Tracker
from gpusense.localization.verdict import Verdict

# Mask that turns the filter's seed into the rival's seed.
_RIVAL = 0x9E3779B97F4A7C15
# Probability of another place that starts the search for a rival; above the prior before the first scan.
_DOUBT = 0.2


class Recovery:
    """Rivals of a filter's particles.

    Args:
        tracker: The particles.
        verdict: Verdict on their pose.

    Attributes:
        rival: The rival of the particles, if there was one.
        everywhere: Number of places still to be compared with the pose.
    """

    MEMORY: ClassVar[tuple[str, ...]] = ("rival", "everywhere")
    PARTS: ClassVar[tuple[str, ...]] = ()

    def __init__(self, tracker: Tracker, verdict: Verdict) -> None:
        self._tracker, self._verdict = tracker, verdict
        self._searches = tracker.options.recovery == "sensor" and can_search(tracker.sensors)
        self.rival: Rival | None = None
        self.everywhere = 0

    @property
    def active(self) -> Rival | None:
        """The competing rival, or None."""
        return self.rival if self.rival is not None and self.rival.active else None

    def changing(self) -> tuple[Any, ...]:
        """Return the objects whose state a call may change."""
        return (self,) if self.rival is None else (self, *self.rival.changing())

    def keep(self) -> None:
        """Record the buffers that the present call must not overwrite."""
        if self.rival is not None:
            self.rival.keep()

    def restart(self) -> None:
        """Forget the rival for new particles."""
        self.everywhere = 0
        if self.rival is not None:
            self.rival.stop()

    def expect_anywhere(self) -> None:
        """Compare the pose with other places after convergence."""
        self.everywhere = COMPARISONS

    def follow(self, motion: SampledMotion) -> None:
        """Move the rival."""
        if self.rival is not None:
            self.rival.predict(motion)

    def is_doubted(self) -> bool:
        """Return whether the last judged scans contradict the pose, or a rival competes with it."""
        verdict = self._verdict
        apart = self.active is not None or not self._tracker.together
        return apart or verdict.wrong > _DOUBT or verdict.explains_little

    def corrected(self, readings: list[SensorReadings], last: Mapping[int, tuple[Any, ...]]) -> None:
        """Compare the particles with their rival, judge their pose, and search for a rival if scans contradict it.

        A search needs two consecutive judgements that contradict the pose, or one at every fifth to tenth correction.

        Args:
            readings: Indices of sensors with the readings of the correction.
            last: Copies of the same readings with all beams.
        """
        tracker, verdict, rival = self._tracker, self._verdict, self.active
        searches = self._searches and rival is None and (verdict.due or self._is_wanted())
        if rival is not None:
            self._compare(rival, readings)
        if not verdict.is_informed_by(last):
            return
        pose, covariance = tracker.mean_and_covariance()
        verdict.judge(pose, covariance, last, evidence_of(tracker.cloud.summary()))
        if searches and self._is_wanted():
            prior = 0.0 if self.everywhere else PRIOR
            self.everywhere = max(self.everywhere - 1, 0)
            step = tracker.progress.step
            ratio = self._made().start(pose, covariance, list(last.items()), step=step, prior=prior)
            verdict.compared(pose, covariance, ratio)

    def _is_wanted(self) -> bool:
        """Return whether the pose is contradicted or due for comparison, and the particles are not too wide."""
        tracker = self._tracker
        if tracker.wide or (self.everywhere and not tracker.together):
            return False
        return bool(self.everywhere) or self.is_doubted()

    def _compare(self, rival: Rival, readings: list[SensorReadings]) -> None:
        """Correct the rival, and replace the particles if it has won."""
        tracker = self._tracker
        pose, covariance = tracker.mean_and_covariance()
        rival.correct(readings, evidence_of(tracker.cloud.summary()), pose)
        won = rival.judge(pose, covariance, readings)
        if won is not None:
            poses, weights = won
            # The next scans must confirm the new particles.
            tracker.place(poses[starts.rows_by_weight(weights, tracker.cloud.count)])
            self._verdict.doubt()
            self.expect_anywhere()

    def _made(self) -> Rival:
        """Return the rival, made on first use with the sensors of the filter."""
        if self.rival is None:
            tracker = self._tracker
            options = tracker.options._replace(
                least=PARTICLES, most=PARTICLES, seed=tracker.options.seed ^ _RIVAL, recovery=None, beam_skip=None
            )
            cloud = FilterCloud(tracker.sensors, PARTICLES, residual=options.resampling == "residual")
            self.rival = Rival(Tracker(tracker.sensors, options, cloud))
        return self.rival

    # ---- state

    def state(self) -> dict[str, Any]:
        """Return the state as plain data."""
        return {"everywhere": self.everywhere, "rival": None if self.active is None else self.active.state()}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Take over a state."""
        self.everywhere = state["everywhere"]
        if state["rival"] is not None:
            self._made().restore(state["rival"])
        elif self.rival is not None:
            self.rival.stop()
