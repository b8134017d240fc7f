"""Rival of a filter's particles: a second cloud, searched when scans contradict the pose.

Sensor resetting (Lenser and Veloso, "Sensor resetting localization for poorly modelled mobile robots" (2000)) and
augmented MCL (*Probabilistic Robotics* table 8.3) mix new poses into the particles at once. A person in front of the
scanner can then destroy a sound track, since poses chosen for a scan explain that scan. Here the new poses form a
separate cloud with the same odometry and readings. Let p(z_t | z_1 .. z_t-1) be the mean likelihood of a cloud's
predicted particles. The logarithm of the Bayes factor

    B = sum over later scans t of log p_rival(z_t | ...) - log p_filter(z_t | ...)

is evidence for the rival (Kass and Raftery, "Bayes factors" (1995)); the scan that chose the rival is none. Terms of
nearby scans repeat one another, since the same furniture is wrong in all of them; against a tracked pose only the new
part of each counts (:mod:`gpusense.localization.belief`). ``docs/background/localization.md`` describes when a rival
wins.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np

from gpusense.localization import starts
from gpusense.localization.belief import correlation, motion_between, new_part, ratio_of_scan
from gpusense.localization.cloud import Cloud
from gpusense.localization.cloud_state import Contents
from gpusense.localization.journal import plain_state, set_state
from gpusense.localization.motion import SampledMotion
from gpusense.localization.rival_search import RivalSearch, are_apart, can_search, drawn
from gpusense.localization.sensors import SensorReadings
from gpusense.localization.spread import FAR, FAR_TURN, WIDE, deviations
from gpusense.localization.tracker import Progress, Tracker
from gpusense.localization.verdict import Verdict, VerdictState, sightings

# Log Bayes factors of a winning and a losing rival; scans to win for a converged rival, and for a rival with several
# places; largest number of scans.
WIN, LOSE, SCANS, APART, LONGEST = 7.0, -7.0, 3, 8, 15
# Scans after which a rival with several places ends if the beams that meet walls contradict the best place.
SETTLES = 5
# Number of rivals to compare with a pose from a search on the whole map.
COMPARISONS = 3
# Prior log odds of a rival of a tracked pose at an unknown place.
PRIOR = -7.0
# Mask that turns the filter's seed into the rival's seed.
_RIVAL = 0x9E3779B97F4A7C15
# Particles of a rival; half widths around each of its initial poses [m, m, rad].
PARTICLES, _SPREAD = 1000, (0.1, 0.1, 0.05)
# Largest distance and turn between two clouds at a place [m, rad].
_SAME, _SAME_TURN = 0.5, 0.3
# Largest mean ratio of wrong against right of a supported pose; share of the old mean after a new scan.
_RIGHT, _AGAINST, _KEPT = -1.0, 0.0, 0.6
# Largest contribution of a scan [nats].
_MOST = 50.0


class Rival:
    """Rival of a filter: a second set of particles with the filter's sensors, and its log odds against the first."""

    MEMORY: ClassVar[tuple[str, ...]] = (
        "active", "log_odds", "_scans", "_place", "_last", "_prior", "_settled", "_ratios",
    )  # fmt: skip

    def __init__(self, tracker: Tracker, prior: float = PRIOR) -> None:
        self._tracker, self._prior, self.log_odds = tracker, prior, prior
        # Whether it may still win.
        self.active, self._scans, self._settled, self._place = True, 0, False, np.zeros(3)
        # Log ratio of the last scan of each set of sensors, and the particles' pose then.
        self._last: dict[tuple[int, ...], tuple[float, np.ndarray]] = {}
        # Weighted sums of the log-likelihood ratios of the rival and of the particles, and the sum of the weights.
        self._ratios = np.zeros(3)

    def changing(self) -> tuple[Any, ...]:
        """Return the objects whose state a call may change, and keep their present buffers."""
        self._tracker.cloud.keep()
        return self, self._tracker, self._tracker.cloud

    def state(self) -> tuple[dict[str, Any], Contents, dict[str, Any]]:
        """Return the rival as plain data: its state, its particles and their memory."""
        return plain_state(self), *self._tracker.state()

    def restore(self, state: tuple[dict[str, Any], Contents, dict[str, Any]]) -> None:
        """Take over a rival."""
        set_state(self, state[0])
        self._tracker.restore(*state[1:])

    def follow(self, motion: SampledMotion) -> None:
        """Move the rival."""
        self._tracker.follow(motion)

    def correct(self, readings: list[SensorReadings], evidence: float, pose: np.ndarray) -> None:
        """Correct the rival, and compare it with particles at a (3,) pose by the log evidence of both."""
        self._tracker.weigh(readings)
        mine = self._tracker.cloud.summary().evidence
        if math.isfinite(mine) or math.isfinite(evidence):
            ratio = min(max(mine - evidence, -_MOST), _MOST)
            sensors = tuple(index for index, _ in readings)
            before, at = self._last.get(sensors, (0.0, pose))
            # A place from a search on the whole map is no likelier than its rivals: compare them at once.
            rho = correlation(*motion_between(pose, at)) if sensors in self._last and self._prior < 0.0 else 0.0
            self.log_odds += new_part(ratio, before, rho)
            self._last = {**self._last, sensors: (ratio, np.array(pose))}
        self._scans += 1

    def judge(
        self, pose: np.ndarray, covariance: np.ndarray, readings: list[SensorReadings]
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the rival's particles and weights if it has won over a (3,) pose; end it if it cannot win."""
        self._place, own = self._tracker.mean_and_covariance()
        gain = self.log_odds - self._prior
        together = deviations(own)[0] < WIDE
        if not together:
            # The mean of several places is no place.
            poses, weights = self._tracker.host_particles(), self._tracker.host_weights()
            self._place, own = poses[int(np.argmax(weights))], np.zeros((3, 3))
        self._compare(own, pose, covariance, dict(readings))
        if together and not self._settled:
            self._settled = True
            # The particles were once spread out as well: two concentrated clouds start with even odds.
            self.log_odds, gain = (0.0, 0.0) if self._prior == 0.0 else (self.log_odds, gain)
        if together and self.is_at(pose, _SAME, _SAME_TURN):
            self.active = False
        elif gain > WIN and self._scans >= (SCANS if together else APART) and self._is_plausible(better=True):
            self.active = False
            return self._tracker.host_particles(), self._tracker.host_weights()
        elif self._is_late(gain):
            self.active = False
        return None

    def _compare(
        self, own: np.ndarray, pose: np.ndarray, covariance: np.ndarray, readings: dict[int, tuple[Any, ...]]
    ) -> None:
        """Add the ratios of both poses, since among people the likelihood alone prefers places with many walls."""
        sensors = self._tracker.sensors
        pair = [ratio_of_scan(sightings(sensors, readings, *at)) for at in ((self._place, own), (pose, covariance))]
        if not any(map(math.isnan, pair)):
            self._ratios = _KEPT * self._ratios + np.array([*pair, 1.0])

    def _is_plausible(self, *, better: bool = False) -> bool:
        """Return whether the beams that meet walls support the rival, absolutely or relative to the particles."""
        mine, other, weight = self._ratios
        return bool(not weight or (mine / weight < _RIGHT and (mine < other or not better)))

    def _is_late(self, gain: float) -> bool:
        """Return whether a rival has fallen behind or had enough scans; equal concentrated clouds may both stay."""
        mine, _, weight = self._ratios
        if self._scans >= (SCANS if self._settled else SETTLES) and weight and mine / weight > _AGAINST:
            return True
        over = self._scans >= LONGEST
        if self._prior == 0.0 and self._settled:
            return gain < LOSE or (over and not self._is_plausible())
        # A spread-out cloud predicts scans badly.
        return over or (gain < LOSE and self._prior < 0.0 and (self._settled or self._scans >= SCANS))

    def is_at(self, pose: np.ndarray, far: float = FAR, turn: float = FAR_TURN) -> bool:
        """Return whether the rival is within a distance [m] and an angle [rad] of a pose."""
        d = self._place - pose
        return math.hypot(d[0], d[1]) <= far and abs(math.remainder(float(d[2]), math.tau)) <= turn

    def probability(self, pose: np.ndarray) -> float:
        """Return the probability that the rival is right and a pose is wrong."""
        if not self._scans or self.is_at(pose) or not self._is_plausible():
            return 0.0
        return 1 / (1 + math.exp(-min(max(self.log_odds, -_MOST), _MOST)))


class Recovery:
    """Rivals of a filter's particles, by the verdict on their pose."""

    MEMORY: ClassVar[tuple[str, ...]] = ("rival", "everywhere")

    def __init__(self, tracker: Tracker, verdict: Verdict) -> None:
        self._tracker, self._verdict = tracker, verdict
        self._searches = tracker.options.recovery == "sensor" and can_search(tracker.sensors)
        self._search = RivalSearch(tracker.sensors)
        self.rival: Rival | None = None
        # Number of places still to be compared with the pose.
        self.everywhere = 0

    def restart(self) -> None:
        """Forget the rival for new particles."""
        self.everywhere, self.rival = 0, None

    def expect_anywhere(self) -> None:
        """Compare the pose with other places after convergence."""
        self.everywhere = COMPARISONS

    def is_doubted(self) -> bool:
        """Return whether the last judged scans contradict the pose, or a rival competes with it."""
        return self.rival is not None or not self._tracker.together or self._verdict.doubts(self._verdict.state)

    def corrected(self, readings: list[SensorReadings], last: Mapping[int, tuple[Any, ...]]) -> None:
        """Compare the particles with their rival, judge their pose, and search for a rival if scans contradict it.

        A search needs two consecutive judgements that contradict the pose, or one at every fifth to tenth correction.
        ``last`` holds all beams of the readings.
        """
        tracker, verdict, rival = self._tracker, self._verdict, self.rival
        before = verdict.state
        if rival is not None:
            self._compare(rival, readings)
        if not verdict.is_informed_by(last):
            return
        _, (pose, covariance), spread = tracker.described()
        verdict.judge(pose, covariance, last, tracker.cloud.summary().evidence, spread)
        if self._searches and rival is None and self._is_wanted(before):
            prior = 0.0 if self.everywhere else PRIOR
            self.everywhere = max(self.everywhere - 1, 0)
            verdict.compared(pose, covariance, self._start(pose, covariance, list(last.items()), prior))

    def _is_wanted(self, before: VerdictState) -> bool:
        """Return whether to search, by the verdict of ``before`` and the present one."""
        tracker, verdict = self._tracker, self._verdict
        if tracker.wide or (self.everywhere and not tracker.together):
            return False
        if self.everywhere or not tracker.together:
            return True
        return verdict.doubts(verdict.state) and (verdict.doubts(before) or verdict.is_due(before))

    def _compare(self, rival: Rival, readings: list[SensorReadings]) -> None:
        """Correct the rival, and replace the particles if it has won."""
        tracker = self._tracker
        pose, covariance = tracker.mean_and_covariance()
        rival.correct(readings, tracker.cloud.summary().evidence, pose)
        won = rival.judge(pose, covariance, readings)
        if not rival.active:
            self.rival = None
        if won is not None:
            poses, weights = won
            # The next scans must confirm the new particles.
            tracker.place(poses[starts.rows_by_weight(weights, tracker.cloud.count)])
            self._verdict.doubt()
            self.expect_anywhere()

    def _start(
        self, pose: np.ndarray, covariance: np.ndarray, readings: Sequence[SensorReadings], prior: float
    ) -> float:
        """Search for a rival by the last readings; return the log-likelihood ratio of other places, NaN without a map.

        The ratio is against the estimate. Equal steps give equal rivals. Prior log odds of 0 exclude places near it.
        """
        tracker = self._particles
        tracker.progress = Progress(self._tracker.progress.step)
        key, options = tracker.key(), tracker.options
        found = self._search.found(pose, covariance, readings, key, options.temperature)
        tries, score = found.poses, found.score
        if prior == 0.0:
            far = are_apart(tries, pose, 2 * FAR_TURN)
            tries, score = tries[far], score[far]
        chosen = drawn(score, options.most, found.effective)
        if chosen is not None:
            tracker.place(starts.spread(tries[chosen], _SPREAD, options.most, key, each=True))
            self.rival = Rival(tracker, prior)
        return found.ratio

    @functools.cached_property
    def _particles(self) -> Tracker:
        """Particles of rivals, of one at a time."""
        tracker = self._tracker
        options = tracker.options._replace(
            least=PARTICLES, most=PARTICLES, seed=tracker.options.seed ^ _RIVAL, recovery=None, beam_skip=None
        )
        cloud = Cloud(tracker.sensors, PARTICLES, residual=options.resampling == "residual")
        return Tracker(tracker.sensors, options, cloud)

    # ---- state

    def state(self) -> dict[str, Any]:
        """Return the state as plain data."""
        return {"everywhere": self.everywhere, "rival": None if self.rival is None else self.rival.state()}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Take over a state."""
        self.everywhere, self.rival = state["everywhere"], None
        if state["rival"] is not None:
            rival = Rival(self._particles)
            rival.restore(state["rival"])
            self.rival = rival
