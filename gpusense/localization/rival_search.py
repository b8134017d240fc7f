"""Find initial poses of a rival of a filter's particles: candidates for the last readings on the whole map.

Branch and bound searches the whole map for scans (:func:`gpusense.matching.locate.likely_poses`) without missing any
place: once with all beams, and once with the longer half, since people shorten beams. People make the likelihood prefer
places with many walls, so candidates are also weighed by the beams that meet walls
(:mod:`gpusense.localization.belief`). A better fit of the scan at another place than at the estimate is evidence
for the verdict. For landmarks, and if the search finds nothing, poses are drawn at random.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gpusense.localization import starts
from gpusense.localization.belief import ratio_of_places, ratio_of_scan
from gpusense.localization.sensors import Sensor, SensorReadings
from gpusense.localization.spread import FAR, FAR_TURN, deviations
from gpusense.localization.verdict import sightings
from gpusense.matching.locate import likely_poses
from gpusense.models.landmark.base import FeatureModel
from gpusense.models.scan.field import LikelihoodFieldModel
from gpusense.world.parameters import LikelihoodFieldParameters
from gpusense.world.pose_algebra import wrap_angle
from gpusense.world.scanner import classify_ranges

# Candidates of each search on a map; effective number of initial candidates of a rival; beams of a scan in a search.
_CANDIDATES, _EFFECTIVE, _BEAMS = 40, 5, 60
# Covariance of a candidate: half the distances between poses of the search, squared.
SPREAD_OF_POSE = np.diag([0.05**2, 0.05**2, 0.025**2])
# Field parameters of a search, wider than the filter's, since the poses are farther apart.
_FIELD = LikelihoodFieldParameters(z_hit=0.7, z_max=0.0, z_rand=0.3, sigma_hit=0.15)
# Number of random poses, and effective number of initial poses of a rival.
_TRIES, _CHOSEN = 20_000, 100
# Least deviation of random poses around the estimate [m], and margin around landmarks [m].
_NEARBY, _MARGIN = 2.0, 1.0


class Candidates(NamedTuple):
    """Initial poses of a rival, and the comparison with the estimate."""

    poses: np.ndarray  # (M, 3) poses
    score: np.ndarray  # (M,) log-likelihood of each pose, less the ratio of its beams that meet walls
    effective: int  # effective number of initial poses
    # Tempered log-likelihood of the best candidate beyond 1 m or 0.5 rad of the estimate, less the estimate's
    # [nats]; NaN without a search of the whole map.
    lead: float = math.nan
    beams: float = 0.0  # number of independent beams, the temperature times the number of beams
    walls: float = 0.0  # ratio of the beams that meet walls at this candidate
    is_found: bool = False  # true if a candidate is at the estimate

    @property
    def ratio(self) -> float:
        """Log-likelihood ratio of other places against the estimate; NaN without a search of the whole map."""
        return ratio_of_places(self.lead, self.beams, self.walls, is_found=self.is_found)


class RivalSearch:
    """Search for rivals of a filter with these sensors."""

    def __init__(self, sensors: Sequence[Sensor]) -> None:
        self._sensors = sensors
        self._pool: tuple[np.ndarray, starts.Spread] | None = None
        self._field: LikelihoodFieldModel | None = None

    def found(
        self,
        pose: np.ndarray,
        covariance: np.ndarray,
        readings: Sequence[SensorReadings],
        key: starts.Key,
        temperature: float | str,
    ) -> Candidates:
        """Return candidates for the last readings, and compare the estimated (3,) pose with them."""
        tries, effective = self._on_map(readings), _EFFECTIVE
        on_map = len(tries) > 0
        if not on_map:
            tries, effective = self._at_random(pose, covariance, key), _CHOSEN
        judged = np.vstack([tries, pose])
        score, beams = np.zeros(len(judged)), 0.0
        for index, reading in readings:
            sensor = self._sensors[index]
            share = float(sensor.temperature(temperature))
            score += share * np.asarray(sensor.model.log_likelihood(judged, *reading), np.float64)
            beams += share * sensor.beams
        score, reached = score[:-1], float(score[-1])
        if not on_map:
            return Candidates(tries, score, effective)
        ratios, apart = self._ratios(tries, readings), are_apart(tries, pose)
        if not apart.any():
            return Candidates(tries, score - ratios, effective, -math.inf - reached, beams, is_found=True)
        best = np.flatnonzero(apart)[np.argmax((score - ratios)[apart])]
        lead, walls = float(score[best]) - reached, float(ratios[best])
        return Candidates(tries, score - ratios, effective, lead, beams, walls, is_found=not apart.all())

    def _ratios(self, poses: np.ndarray, readings: Sequence[SensorReadings]) -> np.ndarray:
        """Return the log-likelihood ratios (M,) of "wrong" against "right" for poses; 0 without evidence from scans."""
        known = dict(readings)
        ratios = [ratio_of_scan(sightings(self._sensors, known, pose, SPREAD_OF_POSE)) for pose in poses]
        return np.nan_to_num(np.array(ratios))

    def _on_map(self, readings: Sequence[SensorReadings]) -> np.ndarray:
        """Return candidates for the first scan among readings."""
        for index, reading in readings:
            sensor = self._sensors[index]
            if sensor.calibrates:
                return self.likely(sensor, sensor.values_of(reading))
        return np.empty((0, 3))

    def likely(self, sensor: Sensor, ranges: np.ndarray, *, quick: bool = False) -> np.ndarray:
        """Return the likeliest poses (M, 3) of a scan (K,), by all beams and unless ``quick`` by the longer half."""
        if quick:
            return likely_poses(self.field_of(sensor), ranges, _CANDIDATES)
        scanner = sensor.model.scanner
        returned = classify_ranges(ranges, scanner.range_min, scanner.range_max)[0]
        longer = np.where(ranges < np.median(ranges[returned]), np.nan, ranges) if returned.any() else ranges
        return np.vstack([likely_poses(self.field_of(sensor), each, _CANDIDATES) for each in (ranges, longer)])

    def field_of(self, sensor: Sensor) -> LikelihoodFieldModel:
        """Return the cached field of a sensor's map for searches."""
        grid, scanner = sensor.model.grid, sensor.model.scanner
        if self._field is None or self._field.grid is not grid or self._field.scanner is not scanner:
            beams = min(_BEAMS, scanner.count)
            self._field = LikelihoodFieldModel(
                grid, scanner, _FIELD, backend=sensor.model.device.selection, beams=beams
            )
        return self._field

    def _at_random(self, pose: np.ndarray, covariance: np.ndarray, key: starts.Key) -> np.ndarray:
        """Return random poses in free cells or among the landmarks, and around the estimate with any heading."""
        if self._pool is None:
            models, bounds = [sensor.model for sensor in self._sensors], None
            if not any(hasattr(model, "grid") for model in models):
                xy = np.vstack([model.corners for model in models if isinstance(model, FeatureModel)])
                bounds = np.array([xy.min(axis=0) - _MARGIN, xy.max(axis=0) + _MARGIN])
            self._pool = starts.free_pool(models, bounds)
        anywhere = starts.spread(*self._pool, _TRIES // 2, key)
        wide = max(2 * deviations(covariance)[0], _NEARBY)
        around = starts.normal(pose, np.diag([wide**2, wide**2, math.pi**2]), _TRIES // 2, key)
        return np.vstack([anywhere, around])


def are_apart(poses: np.ndarray, pose: np.ndarray, turn: float = FAR_TURN) -> np.ndarray:
    """Return the mask of poses (N, 3) beyond 1 m or a turn [rad] of a pose."""
    way, turned = np.hypot(*(poses[:, :2] - pose[:2]).T), np.abs(wrap_angle(poses[:, 2] - pose[2]))
    return np.asarray((way > FAR) | (turned > turn))


def drawn(score: np.ndarray, count: int, effective: int) -> np.ndarray | None:
    """Draw indices by likelihoods, tempered to an effective number; None if no pose is possible."""
    possible = np.isfinite(score)
    if not possible.any():
        return None
    distance = np.where(possible, score - score[possible].max(), -np.inf)
    low, high = 0.0, 1.0
    for _ in range(40):
        middle = high if low == 0.0 and high == 1.0 else (low + high) / 2
        weight = np.exp(middle * distance, where=possible, out=np.zeros(len(score)))
        size = weight.sum() ** 2 / (weight @ weight)
        if size >= min(effective, np.count_nonzero(possible)):
            low = middle
        else:
            high = middle
        if low >= high:
            break
    weight = np.exp(low * distance, where=possible, out=np.zeros(len(score)))
    return starts.rows_by_weight(weight, count)


def can_search(sensors: Sequence[Sensor]) -> bool:
    """Return whether a sensor has a map for the search."""
    return any(hasattr(one.model, "grid") or isinstance(one.model, FeatureModel) for one in sensors)
