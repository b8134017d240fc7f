"""Whether a filter is lost: how many beams of scans the estimated pose explains, how well features were predicted.

A beam is explained if its log-likelihood at the estimate is nearer to a good one than to a poor one. Poor is the median
of the beams of the scan at random poses in the free space, good the 99th percentile there: a random pose meets the
right range by chance now and then. The share that a filter on the right map explains is near 1, even among people. A
filter on a wrong map fits some walls and explains about half.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from gpusense._util import masks
from gpusense.localization.evidence import Evidence
from gpusense.localization.sensors import Sensor
from gpusense.models.landmark.model import LandmarkModel
from gpusense.models.scan.beam import BeamModel

# Random poses; corrections over which the share is averaged.
_RANDOM, _MEMORY = 64, 5
# Least share of a filter that is not lost, between those of right and wrong maps (bench/studies/verdict.py).
# A likelihood field explains an end near any wall; a beam model asks for the wall that the beam meets.
_LEAST_OF_FIELD, _LEAST_OF_BEAMS = 0.8, 0.55


class Verdict:
    """Running share of explained beams.

    Args:
        sensors: The filter's sensors.
        random_poses: Returns poses anywhere in the free space.
        seed: Seed of the poses among landmarks.

    Attributes:
        corrections: Corrections since the filter began.
    """

    def __init__(self, sensors: Sequence[Sensor], random_poses: Callable[[int], np.ndarray], *, seed: int = 0) -> None:
        self._sensors, self._random_poses, self._seed = sensors, random_poses, seed
        self._poses: np.ndarray | None = None
        self.reset()

    def reset(self) -> None:
        """Forget all scans."""
        self.corrections, self._judged, self._share = 0, 0, math.nan
        self._last = math.nan
        self._least = 0.0
        self._evidence = {
            index: Evidence(sensor.model, seed=self._seed)
            for index, sensor in enumerate(self._sensors)
            if isinstance(sensor.model, LandmarkModel)
        }

    def watches(self, readings: Mapping[int, tuple[Any, ...]]) -> bool:
        """Tell whether readings have features, whose prediction is judged before the correction."""
        return any(index in self._evidence and _count(reading) for index, reading in readings.items())

    def predicted(self, poses: np.ndarray, weights: np.ndarray, readings: Mapping[int, tuple[Any, ...]]) -> None:
        """Add the features of a scan, before the filter is corrected by them."""
        for index, evidence in self._evidence.items():
            if index in readings and _count(readings[index]):
                evidence.predicted(poses, weights, np.asarray(masks.filled(readings[index][0]), np.float64))

    @property
    def gain(self) -> float:
        """Least mean gain of the predictions of features [nats]; NaN without enough of them."""
        gains = [evidence.gain for evidence in self._evidence.values() if not math.isnan(evidence.gain)]
        return min(gains, default=math.nan)

    def anywhere(self) -> np.ndarray:
        """Return poses anywhere in the free space, with which a pose is compared."""
        if self._poses is None:
            self._poses = self._random_poses(_RANDOM)
        return self._poses

    def corrected(self) -> None:
        """Count a correction."""
        self.corrections += 1

    @property
    def due(self) -> bool:
        """Tell whether enough corrections have passed for a new judgement."""
        return self.corrections % _MEMORY == 0

    @property
    def lost(self) -> bool:
        """Tell whether recent scans or features contradict the pose; False before any was judged."""
        return self._share < self._least or any(evidence.lost for evidence in self._evidence.values())

    def explained(self, pose: np.ndarray, readings: Mapping[int, tuple[Any, ...]]) -> float:
        """Return the share of the beams of the last scans that a pose explains; NaN where no reading has beams."""
        if self._judged == self.corrections:
            return self._last
        anywhere = self.anywhere()
        shares, least = [], []
        for index, reading in readings.items():
            if self._sensors[index].calibrates:
                parts = self._sensors[index].parts(np.vstack([pose[None], anywhere]), reading)
                shares.append(explained_share(parts[0], parts[1:]))
                beams = isinstance(self._sensors[index].model, BeamModel)
                least.append(_LEAST_OF_BEAMS if beams else _LEAST_OF_FIELD)
        self._judged = self.corrections
        self._last = float(np.mean(shares)) if shares else math.nan
        if not math.isnan(self._last):
            self._least = float(np.mean(least))
            rate = 1 / min(self.corrections, _MEMORY) if self.corrections else 1.0
            self._share = self._last if math.isnan(self._share) else self._share + rate * (self._last - self._share)
        return self._last


def _count(reading: tuple[Any, ...]) -> int:
    """Return the number of features of a reading; 0 for one that the model will refuse."""
    shape = np.shape(reading[0])
    return int(shape[0]) if shape else 0


def explained_share(at: np.ndarray, elsewhere: np.ndarray) -> float:
    """Return the share of beams that are explained; NaN without beams."""
    used = np.isfinite(at) & (at != 0)
    least = boundary(elsewhere[:, used])
    if least is None:
        return 1.0 if used.any() and np.isfinite(elsewhere[:, used]).any() else math.nan
    return float(np.mean(at[used] > least))


def boundary(elsewhere: np.ndarray) -> float | None:
    """Return the log-likelihood above which a beam is explained, between a poor and a good one.

    Args:
        elsewhere: (M, K) log-likelihoods of used beams at poses anywhere in the free space.

    Returns:
        None where all beams are equally likely everywhere, or none is possible.
    """
    values = elsewhere[np.isfinite(elsewhere)]
    if not values.size:
        return None
    poor, good = np.percentile(values, (50, 99))
    return float((poor + good) / 2) if good > poor else None
