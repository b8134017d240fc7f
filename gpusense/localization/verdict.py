"""Judge a filter or any localiser: the probability of being lost, and a word for it.

``p_lost`` is W + (1 - W) s. W is the belief that another place is right (:mod:`gpusense.localization.belief`), s the
share of the particles, or of a covariance, beyond 1 m or 0.5 rad. Models of positions or headings have no map and no
evidence, and W is omitted.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, NamedTuple

import numpy as np

from gpusense._util import checks
from gpusense.localization.beam_consistency import KNOWN, BeamConsistency
from gpusense.localization.belief import Belief, evidence_of_scan, motion_between, ratio_of_features
from gpusense.localization.motion import STILL, SampledMotion
from gpusense.localization.sensors import Sensor, SensorReadings
from gpusense.localization.spread import TRACKING, Spread, spread_of
from gpusense.models.landmark.base import FeatureModel

# Random poses.
_RANDOM = 64
# Largest belief of a sure pose, and of a pose that is judged seldom, from the least risk of a radius on; distance [m],
# turn [rad], number of corrections, and drop of the readings' log-likelihood [nats] before its next judgement.
_SURE, _SUREST, _WAY, _TURNED, _SELDOM, _DROP = 0.05, 0.01, 0.5, 0.5, 10, 3.0
# Share of these limits at which a correction prepares a judgement, since the estimate differs from the odometry.
_PREDICTED = 0.9
# Corrections before a single judgement of an unsure pose may begin a search.
_INTERVAL = 5
# Least share of explained beams that makes a search elsewhere unnecessary, and the probability of another place that
# starts one; above the prior before the first scan.
_FEW, _DOUBT = 0.4, 0.2
# Gain at which right and wrong are equally likely [nats per feature]; number of poses anywhere, and their margin around
# the landmarks [m].
_LEAST_GAIN, _ANYWHERE, _MARGIN = 1.0, 1000, 1.0


class VerdictState(NamedTuple):
    """Memory of a verdict; immutable, saved and restored by assignment."""

    belief: Belief = Belief()  # belief that the pose is wrong
    corrections: int = 0  # corrections since the filter began
    judged: int = -1  # corrections at the last judgement; -1 before
    explained: float = math.nan  # share of explained beams then; NaN without beams
    ratios: tuple[float, ...] = ()  # ratios of features since the last judgement
    places: int = 0  # number of places searched since the last confirmed place
    evidence: float = -math.inf  # evidence of the last judged readings, by the particles


class Verdict:
    """Running verdict of a filter; ``random_poses`` returns poses anywhere in the free space."""

    MEMORY: ClassVar[tuple[str, ...]] = ("state",)

    def __init__(self, sensors: Sequence[Sensor], random_poses: Callable[[int], np.ndarray], *, seed: int = 0) -> None:
        self._sensors, self._random_poses = sensors, random_poses
        self._evidence = {
            index: Evidence(sensor.model, seed=seed)
            for index, sensor in enumerate(sensors)
            if isinstance(sensor.model, FeatureModel)
        }
        # Pose of the last call of ``judge``, None if it was not sure; no state, since it affects only the speed.
        self._pose: np.ndarray | None = None
        # True if a sensor has a map that can contradict a pose.
        self.informed = bool(self._evidence) or any(sensor.calibrates for sensor in sensors)
        self.state = VerdictState()

    def reset(self, *, anywhere: bool = False) -> None:
        """Forget all scans; ``anywhere`` begins a search on the whole map."""
        self.state = VerdictState(Belief.anywhere() if anywhere else Belief())

    def is_informed_by(self, readings: Mapping[int, tuple[Any, ...]]) -> bool:
        """Return whether any of the readings comes from a sensor with a map, so that the pose is judged."""
        # A generator would be one more call per reading.
        for index in readings:  # noqa: SIM110
            if self._sensors[index].calibrates or index in self._evidence:
                return True
        return False

    def watches(self, readings: Mapping[int, tuple[Any, ...]]) -> bool:
        """Return whether readings include features; their prediction is judged before the correction."""
        if not self._evidence:
            return False
        return any(index in self._evidence and _count(reading) for index, reading in readings.items())

    def predicted(self, poses: np.ndarray, weights: np.ndarray, readings: Mapping[int, tuple[Any, ...]]) -> None:
        """Add the features of a scan before they correct the filter."""
        ratios = self.state.ratios
        for index, evidence in self._evidence.items():
            if index not in readings or not _count(readings[index]):
                continue
            features = np.asarray(checks.filled(readings[index][0]), np.float64)
            gain = evidence.gain(poses, weights, features)
            if not math.isnan(gain):
                ratios = *ratios, ratio_of_features(gain, len(features), _LEAST_GAIN)
        self.state = self.state._replace(ratios=ratios)

    @functools.cached_property
    def anywhere(self) -> np.ndarray:
        """Poses anywhere in the free space, for comparison."""
        return self._random_poses(_RANDOM)

    def corrected(self) -> None:
        """Count a correction."""
        state = self.state
        # Faster than ``_replace``.
        self.state = VerdictState(state.belief.counted(), state.corrections + 1, *state[2:])

    def is_due(self, state: VerdictState) -> bool:
        """Return whether a single judgement after a state may begin a search."""
        return state.corrections % (_SELDOM if state.belief.wrong <= _SURE else _INTERVAL) == 0

    def doubt(self) -> None:
        """Restart at a pose from a search; the scans of the search are no evidence for it."""
        places = self.state.places + 1
        self.state = self.state._replace(belief=Belief.anywhere(after=places - 1), judged=-1, places=places)

    def doubts(self, state: VerdictState) -> bool:
        """Return whether the scans of a state contradict the pose, or few of the last judged beams agree with it."""
        return state.explained < _FEW or (self.informed and state.belief.wrong > _DOUBT)

    @property
    def wrong(self) -> float:
        """Probability that another place is right, by the scans; 0 for sensors without a map."""
        return self.state.belief.wrong if self.informed else 0.0

    def judge(
        self,
        pose: np.ndarray,
        covariance: np.ndarray,
        readings: Mapping[int, tuple[Any, ...]],
        evidence: float = -math.inf,
        spread: Spread | None = None,
    ) -> float:
        """Judge a pose (3,) by the last readings, unless they add almost nothing to a sure pose.

        Return the share of explained beams, or NaN. The evidence is log p(last | earlier readings) of the particles.
        """
        state, spread = self.state, spread_of(covariance) if spread is None else spread
        self._pose = None if spread.wide else pose
        if not spread.wide and evidence >= state.evidence - _DROP and self._is_near(pose):
            return state.explained
        scans = sightings(self._sensors, readings, pose, covariance)
        ratio, explained = evidence_of_scan(scans)
        belief = state.belief
        x, y, theta = pose.tolist()
        if spread.apart:
            belief = belief.widened()
        elif spread.wide:
            belief = belief.judged((x, y, theta), math.nan)
        else:
            if state.ratios:
                of_features = float(np.mean(state.ratios))
                ratio = of_features if math.isnan(ratio) else ratio + of_features
            belief = belief.judged((x, y, theta), ratio)
        places, count = 0 if belief.wrong < TRACKING else state.places, state.corrections
        self.state = VerdictState(belief, count, count, explained, (), places, evidence)
        return explained

    def expected(self, readings: Sequence[SensorReadings], motion: SampledMotion | None) -> list[SensorReadings]:
        """Return the scans that will probably be judged after the next correction, for judging them within it."""
        # A sure pose will probably stay near the last judged pose.
        if self._pose is not None and self._is_near((motion or STILL).after(self._pose.tolist()), 1, _PREDICTED):
            return []
        scans = []
        for index, reading in readings:
            sensor, ranges = self._sensors[index], reading[0]
            # The model checks, and refuses or converts, other types.
            plain = type(ranges) is np.ndarray and ranges.dtype.kind == "f"
            if sensor.calibrates and plain and ranges.shape == (sensor.model.scanner.count,):
                scans.append((index, reading))
        return scans

    def _is_near(self, pose: np.ndarray | Sequence[float], later: int = 0, share: float = 1.0) -> bool:
        """Return whether a pose is sure, and within a share of the limits of the last judged pose."""
        state = self.state
        before = state.belief.pose
        if before is None or state.judged < 0 or state.belief.wrong > _SUREST or state.ratios:
            return False
        way, turn = motion_between(pose, before)
        return way < share * _WAY and turn < share * _TURNED and state.corrections + later - state.judged < _SELDOM

    def compared(self, pose: np.ndarray, covariance: np.ndarray, ratio: float) -> None:
        """Add the ratio of other places against the last judged pose (3,), or NaN, unless its covariance is wide."""
        if spread_of(covariance).wide:
            return
        x, y, theta = (float(value) for value in pose)
        self.state = self.state._replace(belief=self.state.belief.compared_with((x, y, theta), ratio))


class Evidence:
    """Gain of particles over chance in predicting features of a model of landmarks or lines.

    Before each correction, the mean likelihood of the features over the particles is compared with the larger of two
    alternatives: the mean over poses anywhere among the landmarks, and the likelihood of false positives only. The
    difference, in nats per feature, is the logarithm of a Bayes factor (Jeffreys 1961). A filter that follows the robot
    gains several nats. A filter on a wrong map or at a wrong place gains none, even with noise fitted to a wrong map.
    """

    def __init__(self, model: FeatureModel, *, seed: int = 0) -> None:
        self._model = model
        xy, rng = model.corners, np.random.default_rng(seed)
        low, high = xy.min(axis=0) - _MARGIN, xy.max(axis=0) + _MARGIN
        self._poses = np.column_stack(
            [rng.uniform(low, high, (_ANYWHERE, 2)), rng.uniform(-math.pi, math.pi, _ANYWHERE)]
        )

    def gain(self, poses: np.ndarray, weights: np.ndarray, features: np.ndarray) -> float:
        """Return the gain of (N, 3) predicted particles over chance in predicting (F, ...) features [nats].

        Landmarks count as unidentified, since exchanged landmarks of a map leave a right pose right. The gain is NaN if
        neither particles nor chance can explain the features.
        """
        count = len(features)
        false = self._log_p(self._poses[:1], features, np.full(count, -1))[0]
        z_false = self._model.parameters.z_false
        chance = _log_mean(self._log_p(self._poses, features), np.full(_ANYWHERE, 1 / _ANYWHERE))
        if z_false > 0:
            chance = max(chance, float(false) - count * math.log(z_false))
        reached = _log_mean(self._log_p(poses, features), weights)
        return reached - chance if math.isfinite(chance) or math.isfinite(reached) else math.nan

    def _log_p(self, poses: np.ndarray, features: np.ndarray, ids: Any = None) -> np.ndarray:
        return np.asarray(self._model.log_likelihood(poses, features, ids), np.float64)


def sightings(
    sensors: Sequence[Sensor], readings: Mapping[int, tuple[Any, ...]], pose: np.ndarray,
    covariance: np.ndarray = KNOWN,
) -> list[BeamConsistency]:  # fmt: skip
    """Return the judged beams of all scans among readings."""
    chosen = [(sensors[index], reading[0]) for index, reading in readings.items() if sensors[index].calibrates]
    return [one.judge().consistency(one.model.scanner, pose, ranges, covariance) for one, ranges in chosen]


def _count(reading: tuple[Any, ...]) -> int:
    """Return the number of features of a reading; 0 if the model will refuse it."""
    shape = np.shape(reading[0])
    return int(shape[0]) if shape else 0


def _log_mean(log_p: np.ndarray, weights: np.ndarray) -> float:
    """Return the logarithm of a weighted mean of likelihoods."""
    largest = float(log_p.max())
    if not math.isfinite(largest):
        return largest
    with np.errstate(divide="ignore"):
        return largest + float(np.log(weights @ np.exp(log_p - largest)))
